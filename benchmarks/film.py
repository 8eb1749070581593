"""What a film of 10 s takes.

100 frames, 788 pixels wide, of EKF-SLAM in `cloister`, of FastSLAM 2.0 with 100 particles in
`cloister_noisy`, and of SEIF with 8 active landmarks and 6 links a landmark in `loop`: processor
seconds of one core, the run itself left out, for MP4 (where ffmpeg is), GIF and the player.
"""

import resource
import tempfile
import time
from pathlib import Path
from typing import Any

import jax

from benchmarks.gate import Metric
from jaxslam import catalog, filters, plot, run, scenarios, simulate
from jaxslam.results.plot._film import mp4_problem

MOST = 30.0
"""processor seconds of a film of 10 s"""


def cases() -> dict[str, tuple[Any, Any]]:
    """A world and a filter, by name."""
    cloister, noisy = scenarios.cloister(250), scenarios.cloister_noisy(250)
    loop = scenarios.loop(800)
    seif = filters.Seif(loop.motion, loop.sensor, 20, active=8, links=6, exact_marginals=True)
    return {
        "ekf": (cloister, catalog.variant(cloister)),
        "fastslam": (noisy, filters.FastSlam(noisy.motion, noisy.sensor, 36, 100)),
        "seif": (loop, seif),
    }


def measure(quick: bool = False) -> list[Metric]:
    """The seconds of each film."""
    metrics = []
    for name, (world, filter) in cases().items():
        key = jax.random.key(0)
        truth, log = simulate(world, key)
        trace = run(filter, log, world.pose, world.pose_cov, key, probe=plot.probe)
        jax.block_until_ready(trace)
        film = plot.animate(trace, log, truth, title=f"{world.name}: {name}")
        total, sizes = 0.0, []
        for kind in [*["mp4"] * (mp4_problem() is None), "gif", "html"]:
            with tempfile.NamedTemporaryFile(suffix=f".{kind}") as file:
                began = processor_seconds()
                film.save(Path(file.name))
                total += processor_seconds() - began
                sizes.append(f"{kind} {Path(file.name).stat().st_size / 1e6:.1f} MB")
        what = f"film of 10 s, {name} [processor s]"
        metrics.append(Metric(what, total, high=MOST, note=", ".join(sizes)))
    return metrics


def processor_seconds() -> float:
    """Of this process and of those that have ended."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + ended.ru_utime + ended.ru_stime
