"""One core, one precision: `python -m benchmarks.speed.single float64` prints metrics as JSON."""

# ruff: noqa: E402
from benchmarks.speed.timing import Limit, best, pin, together

pin()

import json
import sys
import time
from functools import partial

import jax
import numpy as np

from benchmarks.speed import roofline
from benchmarks.speed.area import compressed
from benchmarks.speed.dense import dense_ekf
from benchmarks.speed.peers import Mrpt, dynamax_ekf
from jaxslam.catalog import FILTERS
from jaxslam.filters.ekf.ekf_slam import EkfSlam
from jaxslam.math.xla import hot_options
from jaxslam.run import run
from jaxslam.simulation.scenarios import cloister
from jaxslam.simulation.worlds import simulate

RUNS, PEERS_RUNS = 32, 4
VISIBLE = 20
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
    actions = {"batch": batch, "single": single}
    limit = Limit(dtype)
    if limit.there:
        actions["limit"] = lambda: limit.run(RUNS)
    few = jax.tree.map(lambda leaf: leaf[:PEERS_RUNS], logs)
    peer = dynamax_ekf(scenario, few)
    if peer is not None:
        actions["dynamax"] = peer
    mrpt, mrpt_seconds = Mrpt(), []
    if mrpt.there:
        actions["MRPT"] = lambda: mrpt_seconds.append(mrpt.run(PEERS_RUNS))
    seconds = together(actions)
    each = seconds["batch"] / RUNS
    numpy_seconds = best(lambda: dense_ekf(numpy_log, scenario.pose, noise_u, noise_z), 1)
    peak, stream = roofline.ceilings(np.dtype(dtype))
    count, flops, reads = roofline.corrections(36, 200)
    reads *= np.dtype(dtype).itemsize
    out = {
        "trace and compile [s]": build,
        "first call / steady": first / seconds["batch"],
        "runs/s per core": 1 / each,
        "peak temporary memory a run [MB]": program.memory_analysis().temp_size_in_bytes
        / RUNS
        / 1e6,
        "largest difference from NumPy": float(np.abs(ours - plain).max()),
        "NumPy / ours, a run": numpy_seconds / each,
        "corrections a run": count,
        "flop rate of the corrections [GFLOP/s]": flops / each / 1e9,
        "peak [GFLOP/s]": peak / 1e9,
        "memory [GB/s]": stream / 1e9,
        "share of peak": flops / each / peak,
        "flops per byte of P": flops / reads,
    }
    if limit.there:
        fair = seconds["limit"] / RUNS
        out |= {
            "limit / ours": fair / each,
            "limit / ours, one trajectory": fair / seconds["single"],
            "limit [s a run]": fair,
        }
    if peer is not None:
        out["dynamax / ours, a run"] = seconds["dynamax"] / PEERS_RUNS / each
    if mrpt.there:
        out["MRPT / ours, a run"] = min(mrpt_seconds) / each
    return out


def exponent(sizes, seconds):
    """The slope of log time by log size."""
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def scaling():
    """Exponents in landmarks, visible landmarks, steps and runs; and what padding costs."""
    scenario = cloister(40)
    _, logs = logs_of(scenario, 1)
    log = jax.tree.map(lambda leaf: leaf[0], logs)

    def program(capacity, visible, places=None, steps=40):
        def cut(leaf):
            return leaf[:steps, :visible]

        scan = jax.tree.map(cut, log.scan)
        spare = (places or visible) - visible
        scan = scan._replace(
            z=np.pad(scan.z, [(0, 0), (0, spare), (0, 0)]),
            tag=np.pad(scan.tag, [(0, 0), (0, spare)], constant_values=-1),
            valid=np.pad(scan.valid, [(0, 0), (0, spare)]),
        )
        filter = EkfSlam(
            scenario.motion,
            scenario.sensor,
            capacity,
            **(scenario.filter_options | {"births": None}),
        )
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
    local, ordinary = compressed(scenario, log._replace(control=log.control[:40], scan=scan), SIZES)
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


def main():
    dtype = sys.argv[1]
    jax.config.update("jax_enable_x64", dtype == "float64")
    out = throughput(dtype)
    if dtype == "float64":
        out |= scaling()
    print(json.dumps({f"{dtype}, {name}": value for name, value in out.items()}))


if __name__ == "__main__":
    main()
