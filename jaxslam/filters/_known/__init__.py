"""Filters with a known map or known poses, and dead reckoning."""
