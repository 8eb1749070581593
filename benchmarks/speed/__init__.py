"""Speed beside a hand-written limit: see `__main__`."""
