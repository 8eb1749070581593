"""The steps of a scan, in the order of the textbook."""
