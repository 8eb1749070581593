"""Information filters: the exact one, and two that keep the information matrix sparse."""
