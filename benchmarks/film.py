"""What a film of 10 s takes: `python -m benchmarks.film [--out FOLDER]`.

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

from benchmarks.gate import Metric, alone
from jaxslam import catalog, filters, plot, scenarios
from jaxslam.run import run
from jaxslam.simulation.worlds import simulate

MOST = 30.0
"""processor seconds of a film of 10 s"""


def cases() -> dict[str, tuple[Any, Any]]:
    """A world and a filter, by name."""
    cloister, noisy, loop = (
        scenarios.cloister(250),
        scenarios.cloister_noisy(250),
        scenarios.loop(800),
    )
    return {
        "ekf": (cloister, catalog.variant(cloister)),
        "fastslam": (noisy, filters.FastSlam(noisy.motion, noisy.sensor, 36, 100)),
        "seif": (
            loop,
            filters.Seif(loop.motion, loop.sensor, 20, active=8, links=6, whole=True),
        ),
    }


def measure(out: Path | None = None) -> list[Metric]:
    """The seconds of each film. out: a folder for the films, to look at."""
    if out is None:
        with tempfile.TemporaryDirectory() as folder:
            return measure(Path(folder))
    out.mkdir(parents=True, exist_ok=True)
    metrics = []
    for name, (world, filter) in cases().items():
        key = jax.random.key(0)
        truth, log = simulate(world, key)
        trace = run(filter, log, world.pose, world.pose_cov, key, probe=plot.probe)
        jax.block_until_ready(trace)
        film = plot.animate(trace, log, truth, title=f"{world.name}: {name}")
        taken, sizes = {}, {}
        for kind in [*["mp4"] * plot.has_ffmpeg(), "gif", "html"]:
            began = processor_seconds()
            film.save(out / f"{name}.{kind}")
            taken[kind] = processor_seconds() - began
            sizes[kind] = (out / f"{name}.{kind}").stat().st_size
        note = ", ".join(f"{kind} {size / 1e6:.1f} MB" for kind, size in sizes.items())
        parts = ", ".join(f"{kind} {seconds:.1f} s" for kind, seconds in taken.items())
        print(f"{name}: {parts}; {note}", flush=True)
        total = sum(taken.values())
        metrics.append(Metric(f"film of 10 s, {name} [processor s]", total, high=MOST, note=note))
    return metrics


def processor_seconds() -> float:
    """Of this process and of those that have ended."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + ended.ru_utime + ended.ru_stime


if __name__ == "__main__":
    raise SystemExit(alone("film", measure, out={"type": Path, "metavar": "FOLDER"}))
