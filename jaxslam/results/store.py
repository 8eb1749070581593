"""The folder of a campaign's finished blocks of runs, from which a campaign can be resumed."""

from jaxslam.results._store import Store, open, resume

__all__ = ["Store", "open", "resume"]
