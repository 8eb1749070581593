"""Scan matching held against the truth: see `__main__`."""
