"""What models, filters and worlds are made of."""
