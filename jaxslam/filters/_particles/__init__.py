"""Particle filters: FastSLAM, and Monte-Carlo localization."""
