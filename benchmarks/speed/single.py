"""One core, one precision: `python -m benchmarks.speed.single float64` prints metrics as JSON."""

# ruff: noqa: E402
from benchmarks.speed.timing import best, compiled_cpp, pin, together

pin()

import json
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.speed.dense import dense_ekf
from jaxslam import run, simulate
from jaxslam.catalog import FILTERS
from jaxslam.core.slots import Joint
from jaxslam.filters import CompressedEkfSlam, EkfSlam
from jaxslam.filters._ekf.compressed_ekf_slam import open_area
from jaxslam.math._xla import hot_options
from jaxslam.simulation.scenarios import cloister

RUNS = 32
VISIBLE = 20
AREA = 40
"""landmarks that the compressed filter works on"""
SIZES = (36, 100, 300, 1000)


def logs_of(scenario, runs):
    keys = jax.random.split(jax.random.key(0), runs)
    return keys, jax.jit(jax.vmap(partial(simulate, scenario)))(keys)[1]


def final_pose(filter, scenario):
    def go(log, key):
        return run(filter, log, scenario.pose, scenario.pose_cov, key).estimate.pose[-1]

    return go


def filter_alone(scenario):
    """Seconds of the EKF over a batch of runs, with all that a campaign takes of it."""
    filter = FILTERS["ekf"](scenario)
    keys, logs = logs_of(scenario, RUNS)

    def go(log, key):
        trace = run(filter, log, scenario.pose, scenario.pose_cov, key)
        return trace.estimate, trace.info

    call = compiled(jax.vmap(go), logs, keys)[0]
    return together({"alone": call})["alone"]


def compiled(function, *arguments):
    """A call of the program as `run` compiles it, seconds to trace and compile it, those of its
    first call, itself."""
    began = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile(hot_options(jax.default_backend()))
    built = time.perf_counter() - began
    began = time.perf_counter()
    jax.block_until_ready(program(*arguments))
    first = time.perf_counter() - began
    return (lambda: jax.block_until_ready(program(*arguments))), built, first, program


def throughput(dtype):
    """Ratios to the limit and to NumPy, compile time, memory and share of the roofline."""
    scenario = cloister()
    go = final_pose(FILTERS["ekf"](scenario), scenario)
    keys, logs = logs_of(scenario, RUNS)
    batch, build, first, program = compiled(jax.vmap(go), logs, keys)
    one_log = jax.tree.map(lambda leaf: leaf[0], logs)
    single = compiled(go, one_log, keys[0])[0]
    host = tuple(np.asarray(x, np.float64) for x in (one_log.control, one_log.scan.z))
    numpy_log = (*host, np.asarray(one_log.scan.tag))
    noise_u = np.diag([0.01, 0.02]) ** 2
    noise_z = np.diag([0.1, np.deg2rad(1.0)]) ** 2
    plain = dense_ekf(numpy_log, scenario.pose, noise_u, noise_z)
    ours = np.asarray(jax.jit(go)(one_log, keys[0]))
    with tempfile.TemporaryDirectory() as folder:
        flags = ["-DREAL=float"] if dtype == "float32" else []
        limit = compiled_cpp(Path(__file__).with_name("ekf_limit.cpp"), folder, *flags)
        command = [limit, str(RUNS), "200", "7"]  # steps; columns a side
        quiet = partial(subprocess.run, command, check=True, stdout=subprocess.DEVNULL)
        seconds = together({"batch": batch, "single": single, "limit": quiet})
    fair = seconds["limit"] / RUNS
    each = seconds["batch"] / RUNS
    numpy_seconds = best(lambda: dense_ekf(numpy_log, scenario.pose, noise_u, noise_z), 1)
    peak, stream = ceilings(np.dtype(dtype))
    count, flops, reads = corrections(36, 200)
    reads *= np.dtype(dtype).itemsize
    temporary = program.memory_analysis().temp_size_in_bytes
    return {
        "trace and compile [s]": build,
        "first call / steady": first / seconds["batch"],
        "runs/s per core": 1 / each,
        "peak temporary memory a run [MB]": temporary / RUNS / 1e6,
        "largest difference from NumPy": float(np.abs(ours - plain).max()),
        "NumPy / ours, a run": numpy_seconds / each,
        "corrections a run": count,
        "flop rate of the corrections [GFLOP/s]": flops / each / 1e9,
        "peak [GFLOP/s]": peak / 1e9,
        "memory [GB/s]": stream / 1e9,
        "share of peak": flops / each / peak,
        "flops per byte of P": flops / reads,
        "limit / ours": fair / each,
        "limit / ours, one trajectory": fair / seconds["single"],
        "limit [s a run]": fair,
    }


def ceilings(dtype) -> tuple[float, float]:
    """Peak multiply-adds in flop/s, and bytes/s to and from memory, of what XLA makes for one core.

    Peak: x ← a x + b over a vector that stays in the first cache, eight times a pass.
    """
    small, large = jnp.ones(1024, dtype), jnp.ones(2**24, dtype)

    @jax.jit
    def chew(x):
        def body(_, parts):
            for _ in range(8):
                parts = [part * 0.999 + 0.001 for part in parts]
            return parts

        return jax.lax.fori_loop(0, 4000, body, [x, x + 1, x + 2, x + 3])

    @jax.jit
    def stream(x, y):
        return 0.5 * x + y

    jax.block_until_ready((chew(small), stream(large, large)))
    peak = 4000 * 8 * 4 * 2 * small.size / best(lambda: jax.block_until_ready(chew(small)))
    seconds = best(lambda: jax.block_until_ready(stream(large, large)))
    return peak, 3 * large.nbytes / seconds


def corrections(landmarks: int, steps: int, group: int = 3) -> tuple[int, float, float]:
    """Of `cloister` a run: rank-2 corrections, their flops, and bytes of P read and written.

    One landmark enters a step and all of the map are measured, so step t corrects min(t, N).
    """
    size = 3 + 2 * landmarks
    seen = [min(step, landmarks) for step in range(steps)]
    passes = sum(-(-count // group) for count in seen)
    return sum(seen), sum(seen) * 4.0 * size**2, passes * 2.0 * size**2


def exponent(sizes, seconds):
    """The slope of log time by log size."""
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def scaling():
    """Exponents in landmarks, visible landmarks and steps; and what padding costs."""
    scenario = cloister(40)
    _, logs = logs_of(scenario, 1)
    log = jax.tree.map(lambda leaf: leaf[0], logs)

    def program(capacity, visible, places=None, steps=40):
        scan = jax.tree.map(lambda leaf: leaf[:steps, :visible], log.scan)
        spare = (places or visible) - visible
        scan = scan._replace(
            z=np.pad(scan.z, [(0, 0), (0, spare), (0, 0)]),
            tag=np.pad(scan.tag, [(0, 0), (0, spare)], constant_values=-1),
            valid=np.pad(scan.valid, [(0, 0), (0, spare)]),
        )
        options = scenario.filter_options | {"births": None}
        filter = EkfSlam(scenario.motion, scenario.sensor, capacity, **options)
        part = log._replace(control=log.control[:steps], scan=scan)
        return compiled(final_pose(filter, scenario), part, jax.random.key(0))[0]

    def seconds(*arguments, **options):
        return best(program(*arguments, **options), 3)

    by_landmarks = [seconds(n, VISIBLE) for n in SIZES]
    seen = (4, 8, 16, 32)
    by_visible = [seconds(300, n) for n in seen]
    by_steps = [seconds(100, VISIBLE, steps=n) for n in (10, 20, 40)]
    padding = together({n: program(100, VISIBLE, places=n) for n in (VISIBLE, 100)}, 15)
    scan = jax.tree.map(lambda leaf: leaf[:40, :VISIBLE], log.scan)
    local, ordinary = compressed(scenario, log._replace(scan=scan))
    return {
        "exponent in landmarks, 36 to 1000, 20 visible": exponent(SIZES, by_landmarks),
        "exponent in landmarks, 300 to 1000": exponent(SIZES[-2:], by_landmarks[-2:]),
        "exponent in visible landmarks, 4 to 32 of 300": exponent(seen, by_visible),
        "exponent in steps, 10 to 40": exponent((10, 20, 40), by_steps),
        "100 places for 20 measurements / 20 places": padding[100] / padding[VISIBLE],
        "compressed, exponent in landmarks, 36 to 1000, 20 visible": exponent(SIZES, local),
        "compressed, exponent in landmarks, 300 to 1000": exponent(SIZES[-2:], local[-2:]),
        "ordinary / compressed, a step, 1000 landmarks": ordinary / local[-1],
        "ms a step, 1000 landmarks": 1e3 * by_landmarks[-1] / 40,
    }


def map_of(count, scenario):
    """A robot in a map of N landmarks, all correlated: the scenario's, and others further off."""
    rng = np.random.default_rng(0)
    landmarks = np.concatenate([scenario.landmarks, rng.uniform(10, 100, size=(1000, 2))])
    landmarks = landmarks[:count] + 0.01 * rng.normal(size=(count, 2))
    root = 0.1 * rng.normal(size=(3, 3 + 2 * count))
    return Joint(
        pose=jnp.asarray(scenario.pose, float),
        landmarks=jnp.asarray(landmarks),
        cov=jnp.asarray(root.T @ root + 0.01 * np.eye(3 + 2 * count)),
        alive=jnp.ones(count, bool),
        tag=jnp.arange(count, dtype=jnp.int32),
        lin=(),
    )


def seconds_a_step(filter, state, log):
    """Of predict and update along the log, from a state at hand."""
    key = jax.random.key(0)

    @jax.jit
    def go(state, log):
        def step(state, row):
            state = filter.predict(state, row.control, key)
            state, info = filter.update(state, row.scan, key)
            return state, (filter.estimate(state).pose, info.nis)

        return jax.lax.scan(step, state, log)[1]

    jax.block_until_ready(go(state, log))
    return best(lambda: jax.block_until_ready(go(state, log)), 3) / len(log.control)


def compressed(scenario, log):
    """Seconds a step of the compressed filter by N, on a trajectory that stays within one part of
    the map, and of the ordinary one at the largest N."""
    options = scenario.filter_options | {"births": None}
    by_landmarks = []
    for count in SIZES:
        joint = map_of(count, scenario)
        plain = EkfSlam(scenario.motion, scenario.sensor, count, **options)
        filter = CompressedEkfSlam(plain, area=AREA)
        by_landmarks.append(seconds_a_step(filter, open_area(joint, AREA), log))
    return by_landmarks, seconds_a_step(plain, joint, log)


def main():
    dtype = sys.argv[1]
    jax.config.update("jax_enable_x64", dtype == "float64")
    out = throughput(dtype)
    if dtype == "float64":
        out |= scaling()
    print(json.dumps({f"{dtype}, {name}": value for name, value in out.items()}))


if __name__ == "__main__":
    main()
