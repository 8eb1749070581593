"""`python -m jaxslam`, the same as the command `jaxslam`."""

import sys

from jaxslam._cli import main

if __name__ == "__main__":  # the workers of mpi4py.futures import this module under another name
    sys.exit(main())
