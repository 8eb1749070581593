"""Coordinates of the error state, and changes between them."""
