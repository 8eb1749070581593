"""Derivatives of a function: computed in several ways, and where they fail."""
