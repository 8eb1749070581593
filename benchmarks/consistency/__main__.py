"""The published consistency experiments.

python -m benchmarks.consistency [--quick] [--record]
"""

from benchmarks.__main__ import main

if __name__ == "__main__":
    raise SystemExit(main(("circle", "loop", "webmap", "stationary")))
