"""Weighted particles: their states and moments."""
