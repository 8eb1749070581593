"""Is a filter honest? Scores of runs, their averages with bands and intervals, and a verdict."""

from jaxslam.consistency.alignment import align_map
from jaxslam.consistency.bound import posterior_bound
from jaxslam.consistency.credibility import credibility
from jaxslam.consistency.nees import DOF, mean_pose_nees, own_error_of
from jaxslam.consistency.score import LAGS, LANDMARK_DOF, LEVELS, Score, score
from jaxslam.consistency.summary import LEVEL, Measure, Summary, interval, judge, summarize
from jaxslam.consistency.tally import Tally, condense

__all__ = [
    "DOF",
    "LAGS",
    "LANDMARK_DOF",
    "LEVEL",
    "LEVELS",
    "Measure",
    "Score",
    "Summary",
    "Tally",
    "align_map",
    "condense",
    "credibility",
    "interval",
    "judge",
    "mean_pose_nees",
    "own_error_of",
    "posterior_bound",
    "score",
    "summarize",
]
