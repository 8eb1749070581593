"""Map management: pruning, merging of duplicates, loop closure, relocalization."""
