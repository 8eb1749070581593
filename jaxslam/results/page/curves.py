"""The curves of a campaign as JSON, for the script of the page (`live.js`), bounded in size.

A curve of more steps than there is room for has for each group of successive steps its least and
its greatest value, so that no extreme is lost; numbers have four digits.
"""

import json
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxslam.consistency import DOF, LEVELS
from jaxslam.consistency.measures import Measure, in_figure
from jaxslam.consistency.measures.errors import bound_curve
from jaxslam.monte_carlo import Campaign
from jaxslam.results.files import Json
from jaxslam.results.plot.campaigns.layout import numbers_of

NUMBERS = 120_000
"""About as many numbers at most stand in a page, in up to 1 MB."""

MOST, LEAST = 1024, 64
"""Numbers of a curve at most, and where there are so many curves that few remain for each."""

_NOTHING = 1e-6
"""Information on a heading that counts as none [1/rad²]."""

_OVER_TIME = 10
"""Curves over time of a filter: three of NEES with two ends of a band, two of RMSE, others."""


class Curves(NamedTuple):
    """What the page embeds of a campaign's curves."""

    text: str
    """JSON without `<`, which may stand within a script element"""
    each: int
    """number of steps that a point stands for"""


def embedded_curves(campaign: Campaign) -> Curves:
    """The curves of every figure that the page draws by itself."""
    room = int(np.clip(NUMBERS // (_OVER_TIME * len(campaign.filters)), LEAST, MOST))
    each = 1 if campaign.steps <= room else -(-2 * campaign.steps // room)
    make = _Panels(campaign, each)
    lags = [*range(1, len(next(iter(campaign.filters.values())).autocorrelation) + 1)]
    charts = [
        _chart("nees", "step", [make.panel(one, "log") for one in in_figure("nees")]),
        _chart("rmse", "step", [make.panel(one, "zero") for one in in_figure("rmse")]),
        _chart("coverage", "probability p", [make.coverage(block) for block in DOF], beside=True),
        _chart("whiteness", "lag [steps]", [make.whiteness(lags)]),
        _chart("gained", "step", [make.panel(one, "floor") for one in in_figure("gained")]),
    ]
    numbers = numbers_of(list(campaign.filters))
    content = {
        "filters": list(campaign.filters),
        "looks": [numbers[name] for name in campaign.filters],
        "steps": campaign.steps,
        "each": each,
        "charts": [chart for chart in charts if chart["panels"]],
    }
    text = json.dumps(content, allow_nan=False, ensure_ascii=False, separators=(",", ":"))
    return Curves(text.replace("<", "\\u003c"), each)


def _chart(figure: str, x: str, panels: Sequence[Json | None], beside: bool = False) -> Json:
    shown = [panel for panel in panels if panel is not None]
    return {"figure": figure, "x": x, "beside": beside, "panels": shown}


class _Panels:
    """Makes the panels of the figures of a campaign."""

    def __init__(self, campaign: Campaign, each: int) -> None:
        self.campaign, self.each = campaign, each
        self.summaries = list(campaign.filters.values())

    def panel(self, measure: Measure, scale: str) -> Json | None:
        """The panel of a measure over the steps, or None where no filter has such a curve."""
        key, bound = measure.key, bound_curve(measure)
        found = [s.curves.get(key) for s in self.summaries]
        values = [None if curve is None else self._thinned(curve) for curve in found]
        if all(value is None for value in values):
            return None
        ends = [
            (s.curves[f"{key}_low"], s.curves[f"{key}_high"]) if f"{key}_low" in s.curves else None
            for s in self.summaries
        ]
        out = _banded(
            [
                None if end is None else [self._thinned(end[0]), self._thinned(end[1])]
                for end in ends
            ],
            [s.counts["runs"] for s in self.summaries],
        )
        line: Json | None = None
        bounds = [s.curves[bound] for s in self.summaries if bound in s.curves]
        if bounds:
            line = {
                "label": "conditional Cramér-Rao bound",
                "values": self._thinned(bounds[0]),
            }
        elif measure.honest:
            line = {"label": "honest", "values": measure.honest}
        return out | {
            "title": measure.axis,
            "scale": scale,
            "values": values,
            "reference": line,
            "honest": measure.honest or None,
            "floor": _NOTHING,
        }

    def coverage(self, block: str) -> Json:
        """The panel of the share of truth within the ellipsoids of a block."""
        return {
            "title": f"{block} (dof {DOF[block]}): share of truth within",
            "scale": "unit",
            "at": [float(level) for level in LEVELS],
            "limits": [0, 1],
            "values": [_numbers(s.coverage[block]) for s in self.summaries],
            "bands": [],
            "banded": [],
            "band": None,
            "reference": {"label": "honest", "values": _numbers(np.asarray(LEVELS))},
        }

    def whiteness(self, lags: list[int]) -> Json:
        """The panel of the autocorrelation of innovations; the widest band is drawn."""
        halves = [s.autocorrelation_band for s in self.summaries]
        bands = [[_numbers(-half), _numbers(half)] for half in halves]
        first = [np.nan_to_num(half[0], posinf=0.0) for half in halves]
        return _banded(
            [band if h > 0 else None for band, h in zip(bands, first, strict=True)], first
        ) | {
            "title": "autocorrelation",
            "scale": "symmetric",
            "at": lags,
            "limits": [lags[0] - 0.5, lags[-1] + 0.5],
            "values": [_numbers(s.autocorrelation) for s in self.summaries],
            "reference": {"label": "honest", "values": 0},
        }

    def _thinned(
        self, values: Float[np.ndarray, " T"]
    ) -> list[float | None] | list[list[float | None]]:
        """The values, or the least and the greatest of every `each` steps."""
        if self.each == 1:
            return _numbers(values)
        values = np.where(np.isfinite(values), values, np.nan)
        wide = np.pad(values, (0, -len(values) % self.each), constant_values=np.nan)
        groups = wide.reshape(-1, self.each)
        absent = np.isnan(groups)
        return [
            _numbers(np.where(absent, np.inf, groups).min(axis=1)),
            _numbers(np.where(absent, -np.inf, groups).max(axis=1)),
        ]


def _banded(bands: Sequence[Sequence[object] | None], weights: Sequence[float]) -> Json:
    """Bands without repetition, each filter's place in them, and the place of the drawn one.

    Drawn is the band of the filter with the greatest weight.
    """
    kept: list[Sequence[object]] = []
    places: list[int | None] = []
    for band in bands:
        if band is not None and band not in kept:
            kept.append(band)
        places.append(None if band is None else kept.index(band))
    there = [i for i, place in enumerate(places) if place is not None]
    drawn = places[max(there, key=lambda i: weights[i])] if there else None
    return {"bands": kept, "banded": places, "band": drawn}


def _numbers(values: Float[np.ndarray, " K"]) -> list[float | None]:
    """Four digits of each number; None for one that is not finite."""
    return [float(f"{value:.4g}") if np.isfinite(value) else None for value in values]
