"""A block of runs: the programs that draw, filter and score it, and how they are compiled."""
