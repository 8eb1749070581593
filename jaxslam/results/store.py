"""The folder of a campaign's finished blocks of runs, from which a campaign can be resumed.

A block is an npz file that appears only when it is complete, so an interrupted
program loses no other block than the current one. A file that is damaged or belongs to another
campaign is renamed and not counted. A manifest holds the caller's settings and the identity of
the campaign.
"""

from jaxslam._public import publish
from jaxslam.results._store import Store, open, resume

__all__ = ["Store", "open", "resume"]

publish(__name__)
