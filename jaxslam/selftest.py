"""Whether this installation computes right on this processor: `python -m jaxslam.selftest`."""

import sys

from jaxslam._public import publish
from jaxslam._selftest import main

__all__ = ["main"]

if __name__ == "__main__":
    sys.exit(main())

publish(__name__)
