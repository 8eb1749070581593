"""Association methods compared.

The cost beside a correction, and of compiling; one scan as the heading becomes uncertain; Victoria
Park without its identities; whole runs with clutter; a long loop. Quick leaves out the last two.
"""

import numpy as np

from benchmarks.association import closing, clutter, cost, heading, park
from benchmarks.gate import Metric, save, show


def measure(quick: bool = False) -> list[Metric]:
    metrics = []
    seconds = cost.measure()
    print("\n20 measurements, 200 landmarks, 16 runs together, time a run:")
    for name, value in seconds.items():
        ratio = value / seconds["correction"]
        print(f"{name:24}{1e6 * value:10.0f} µs{ratio:8.2f} × correction")
        if name not in ("correction", "joint"):
            metrics.append(Metric(f"association, {name} / correction", ratio, high=2.0))
    for name, value in cost.compile_seconds().items():
        high = np.inf if "gradient" in name else 20.0  # nothing was asked of the gradient
        metrics.append(Metric(f"compile time, {name} [s]", value, high=high))

    found = heading.measure()
    rows = {
        f"σ = {sigma:g}°": {name: right[i] for name, (right, _) in found.items()}
        for i, sigma in enumerate(heading.SIGMAS)
    }
    show("share associated rightly", rows)

    rows = park.measure()
    show("Victoria Park, identities ignored, against identities given", rows)
    figures = rows[min(rows, key=lambda name: rows[name]["left over"])]
    wrong = max(figures["wrong [%]"], figures["by birth [%]"])
    metrics.append(Metric("Victoria Park, wrong associations [%]", wrong, high=5.0))
    metrics.append(Metric("Victoria Park, map from known [m]", figures["map RMSE [m]"], high=1.0))
    if quick:
        return metrics

    save(heading.draw(found), "association_heading")
    show("one false measurement a scan, odometry noise 3 ×, 32 runs", clutter.measure())
    rows, pictures = closing.measure()
    show(f"a long loop, {closing.RUNS} runs", rows)
    save(closing.draw(pictures, closing.SHOWN), "association_closing")
    found, wrong = (rows["cluster"][column] for column in ("re-found [%]", "wrong [%]"))
    metrics.append(Metric("long loop, first landmarks found again [%]", found, low=75.0))
    metrics.append(Metric("long loop, wrong associations after it [%]", wrong, high=1.0))
    return metrics
