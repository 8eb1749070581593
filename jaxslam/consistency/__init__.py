"""Is a filter honest? Scores of runs, their averages with bands and intervals, and a verdict."""

from jaxslam._public import publish
from jaxslam.consistency._bound import conditional_bound, posterior_bound
from jaxslam.consistency._draws import draws, write_draws
from jaxslam.consistency._intervals import Average
from jaxslam.consistency._localization_scores import (
    LocalizationScores,
    LocalizationSummary,
    covering_level,
    judge_localization,
    summarize_localization,
)
from jaxslam.consistency._log_statistics import Statistic
from jaxslam.consistency._measures import Measure, register
from jaxslam.consistency._measures.coverage import credibility
from jaxslam.consistency._measures.measure import Nees, Runs, RunScores, RunStatistics
from jaxslam.consistency._measures.nees import block_nees, pose_error
from jaxslam.consistency._model_check import CheckedStatistic, ModelCheck, check_models
from jaxslam.consistency._pairs import PairedDifference
from jaxslam.consistency._recording import (
    ClockLag,
    RecordedBlock,
    RecordedErrors,
    RecordingScores,
    judge_recording,
)
from jaxslam.consistency._run_scores import Score, score
from jaxslam.consistency._summary import Summary
from jaxslam.consistency._verdict import Verdict, judge
from jaxslam.consistency.campaign._judging import judge_estimator
from jaxslam.consistency.campaign._run_estimates import Innovations, RunEstimate

__all__ = [
    "Average",
    "CheckedStatistic",
    "ClockLag",
    "Innovations",
    "LocalizationScores",
    "LocalizationSummary",
    "Measure",
    "ModelCheck",
    "Nees",
    "PairedDifference",
    "RecordedBlock",
    "RecordedErrors",
    "RecordingScores",
    "RunEstimate",
    "RunScores",
    "RunStatistics",
    "Runs",
    "Score",
    "Statistic",
    "Summary",
    "Verdict",
    "block_nees",
    "check_models",
    "conditional_bound",
    "covering_level",
    "credibility",
    "draws",
    "judge",
    "judge_estimator",
    "judge_localization",
    "judge_recording",
    "pose_error",
    "posterior_bound",
    "register",
    "score",
    "summarize_localization",
    "write_draws",
]

publish(__name__)
