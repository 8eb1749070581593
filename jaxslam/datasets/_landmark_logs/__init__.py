"""Logs of landmarks: public data sets, and your own tables."""
