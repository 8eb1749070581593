"""Speed and accuracy of rays in grids: see `__main__`."""
