"""Figures of campaigns: measures of many runs, the errors of run 0, panels and scales."""
