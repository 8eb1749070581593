"""How well, and at what cost, measurements are told apart."""
