"""The filters of a campaign by name, configured for a scenario."""

from jaxslam._catalog import ALL, FILTERS, SMOOTHERS, ideal, variant

__all__ = ["ALL", "FILTERS", "SMOOTHERS", "ideal", "variant"]
