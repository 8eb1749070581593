"""The optimization of a graph: models, plans, steps, robust kernels."""
