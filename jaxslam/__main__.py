"""`python -m jaxslam`, the same as the command `jaxslam`."""

import sys

from jaxslam.cli import main

sys.exit(main())
