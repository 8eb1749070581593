"""What the words and counts of a campaign mean, for its table and its page alike."""

from jaxslam.monte_carlo import Campaign

VERDICTS = {
    "consistent": "neither test rejects, which is no proof",
    "optimistic": "the interval of pose NEES or of NIS / dof lies above the honest value: "
    "covariances are claimed too small",
    "pessimistic": "the interval of pose NEES or of NIS / dof lies below the honest value: "
    "covariances are claimed too large",
    "diverged": "over half of the runs diverged or were not finite",
    "incomplete": "not rejected, but over half of the measurements were dropped",
    "undecided": "too few runs, or too unequal, to reject even a pose NEES of 6: take more "
    "runs; a pose that is known exactly, as by mapping, has no NEES",
}
"""Verdicts."""

COUNTS = {
    "fused": "measurements that corrected the estimate",
    "born": "measurements that started a landmark",
    "sighted": "measurements kept until a landmark can be started from them",
    "rejected": "measurements too far from the prediction, which the gate dropped, or not finite",
    "overflow": "measurements of new landmarks, dropped because the map was full",
    "deferred": "measurements of landmarks that were put off to a later scan",
    "repeated": "measurements of a new landmark that was in the same scan before",
    "singular": "measurements whose innovation covariance has no inverse",
    "unmatched": "measurements that were assigned to no landmark, old or new",
    "missed": "landmarks in view for which the scan had no place",
    "singular_steps": "steps without a NEES, since the covariance of the pose has no inverse",
    "removed": "landmarks removed from the map",
    "merged": "pairs of landmarks made one",
    "reduced": "landmarks converted to points",
    "exhausted": "scans whose search for an association ended at its limit",
    "resampled": "scans after which particles were drawn anew by their weights",
    "underflow": "scans that left no particle a weight",
    "invalid": "particles whose pose was not finite",
    "injected": "particles drawn anywhere, to find a lost robot",
    "capped": "steps that asked for more particles than the filter can have",
}
"""Counts, by their names in `Summary.counts`."""


MEASURES = {
    "autocorrelation": (
        "innovation autocorrelation",
        "correlation of whitened innovations with those of the same landmark one step later; 0 "
        "where the filter uses all that measurements say",
    ),
    "noncredibility": (
        "noncredibility",
        "mean of 10 |log10 ρ|, with ρ the NEES over that by the actual covariance of the errors; "
        "a covariance wrong by a factor of 2 has 3 dB",
    ),
    "inclination": (
        "inclination",
        "mean of 10 log10 ρ; above 0 where covariances are claimed too small, below 0 where too "
        "large",
    ),
    "bound_ratio_position": (
        "conditional bound",
        "the Cramér-Rao bound of an RMSE, given the true path",
    ),
    "unobservable": (
        "unobservable directions",
        "dimension of what the filter's own linearized system leaves open; 3 in SLAM, two of "
        "position and one of rotation of robot and map together",
    ),
    "rotation_information": (
        "rotation information",
        "what the filter has learnt of a rotation of robot and map together, which no measurement "
        "contains",
    ),
}
"""Measures that their names do not explain: term and sentence, by key in `Summary.measures`."""


def count_label(name: str) -> str:
    """The name of a count, as a user reads it."""
    return "initialized" if name == "born" else name.replace("_", " ")


def notes_on(campaign: Campaign) -> list[tuple[str, str]]:
    """What a reader of the measures must know of this campaign: terms, each with a sentence."""
    summaries = campaign.filters
    known = {key for summary in summaries.values() for key in summary.measures}
    out = [note for key, note in MEASURES.items() if key in known]
    lowest: dict[str, list[str]] = {}
    for name, summary in summaries.items():
        if summary.honest_nis < 1:
            lowest.setdefault(f"{summary.honest_nis:.3f}", []).append(name)
    if lowest:
        told = [f"{least} ({', '.join(names)})" for least, names in lowest.items()]
        out.append(
            (
                "gate",
                "a gate drops the largest innovations, so that NIS / dof is honest from "
                f"{', '.join(told)} to 1, as the verdict has it; the band is without a gate",
            )
        )
    likely = [s for s in summaries.values() if "log_likelihood" in s.measures]
    if len({s.counts.get("fused") for s in likely}) > 1:
        out.append(
            (
                "log-likelihood",
                "comparable only between filters that fused the same measurements; their numbers "
                "differ here",
            )
        )
    there = {name for s in summaries.values() for name, count in s.counts.items() if count}
    told = [f"{count_label(name)}, {what}" for name, what in COUNTS.items() if name in there]
    return out + [("counts, over all runs", "; ".join(told))] * bool(told)
