"""All filters by name, configured for a scenario: the variants of EKF-SLAM, and filters to compare
them with.

A variant is a chart, a linearizer or an option, given in one line; `monte_carlo` and the command
line run them side by side.

Looked up by name; the error of an unknown one has suggestions for typos.
"""

from jaxslam._catalog import ALL, FILTERS, SMOOTHERS, ideal, variant
from jaxslam._public import publish

__all__ = ["ALL", "FILTERS", "SMOOTHERS", "ideal", "variant"]

publish(__name__)
