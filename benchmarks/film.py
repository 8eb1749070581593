"""What a film of 10 s takes: `python -m benchmarks.film [--out FOLDER]`.

250 frames, 788 pixels wide, of EKF-SLAM in `cloister`, of FastSLAM 2.0 with 100 particles in
`cloister_noisy`, and of SEIF with 8 active landmarks and 6 links a landmark in `loop`: processor
seconds of one core, the run itself left out, for the frames, MP4 (where ffmpeg is), GIF and the
page with the player.
"""

import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from benchmarks.gate import Metric, alone
from jaxslam import catalog, filters, plot, scenarios
from jaxslam.results.film import ffmpeg
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
    metrics = []
    plot.warm_up()
    for name, (world, filter) in cases().items():
        key = jax.random.key(0)
        truth, log = simulate(world, key)
        trace = run(filter, log, world.pose, world.pose_cov, key, probe=plot.probe)
        jax.block_until_ready(trace)
        title = f"{world.name}: {name}"
        film, frames = timed(lambda: plot.animate(trace, log, truth, title=title))
        assert film.seconds == 10.0
        taken, files = {"frames": frames}, {}
        for kind in [*["mp4"] * (ffmpeg() is not None), "gif", "html"]:
            files[kind], taken[kind] = timed(lambda: film.encoded(kind))
        sizes = ", ".join(f"{kind} {len(held) / 1e6:.1f} MB" for kind, held in files.items())
        parts = ", ".join(f"{kind} {seconds:.1f} s" for kind, seconds in taken.items())
        print(f"{name}: {parts}; {sizes}", flush=True)
        total = sum(taken.values())
        metrics.append(Metric(f"film of 10 s, {name} [processor s]", total, high=MOST, note=sizes))
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            for kind, held in files.items():
                (out / f"{name}.{kind}").write_bytes(held)
    return metrics


def timed(make: Callable[[], Any]) -> tuple[Any, float]:
    """What a function returns, and the processor seconds of it and of programs it started."""
    began = processor_seconds()
    made = make()
    return made, processor_seconds() - began


def processor_seconds() -> float:
    """Of this process and of those that have ended."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + ended.ru_utime + ended.ru_stime


if __name__ == "__main__":
    raise SystemExit(alone("film", measure, out={"type": Path, "metavar": "FOLDER"}))
