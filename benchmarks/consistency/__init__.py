"""Published consistency experiments, reproduced: `python -m benchmarks.consistency`."""
