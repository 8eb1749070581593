"""Map management: landmarks removed, duplicates merged, loops closed, a lost robot relocalized."""
