"""Is a filter honest? Scores of runs, their averages with bands and intervals, and a verdict."""

from jaxslam.consistency.bound import (
    RunJacobians,
    conditional_bound,
    final_covariance,
    jacobians_at_truth,
    posterior_bound,
    van_trees,
)
from jaxslam.consistency.intervals import (
    LEVEL,
    Average,
    interval,
    lopsided,
    percentage,
    positive_interval,
)
from jaxslam.consistency.localization_scores import (
    LocalizationScores,
    LocalizationSummary,
    covering_level,
    energy_score,
    judge_localization,
    score_localization,
    seed_spread,
    summarize_localization,
)
from jaxslam.consistency.measures import Measure, register
from jaxslam.consistency.measures.coverage import LEVELS, credibility
from jaxslam.consistency.measures.measure import RunStatistics
from jaxslam.consistency.measures.nees import DOF, own_error_of
from jaxslam.consistency.measures.observability import monitor_of
from jaxslam.consistency.run_scores import LAGS, Score, run_statistics, score
from jaxslam.consistency.summary import Summary, summarize
from jaxslam.consistency.tally import Tally, condense
from jaxslam.consistency.verdict import Verdict, judge, power_of

__all__ = [
    "DOF",
    "LAGS",
    "LEVEL",
    "LEVELS",
    "Average",
    "LocalizationScores",
    "LocalizationSummary",
    "Measure",
    "RunJacobians",
    "RunStatistics",
    "Score",
    "Summary",
    "Tally",
    "Verdict",
    "condense",
    "conditional_bound",
    "covering_level",
    "credibility",
    "energy_score",
    "final_covariance",
    "interval",
    "jacobians_at_truth",
    "judge",
    "judge_localization",
    "lopsided",
    "monitor_of",
    "own_error_of",
    "percentage",
    "positive_interval",
    "posterior_bound",
    "power_of",
    "register",
    "run_statistics",
    "score",
    "score_localization",
    "seed_spread",
    "summarize",
    "summarize_localization",
    "van_trees",
]
