"""The sparse information filter: `python -m benchmarks.seif [--runs 10] [--steps 300] [--park]`.

SEIF beside the EKF, on the same draws of `circle` and of a cloister seen 3 m far: the error of its
map, and its NEES by the Markov-blanket marginals that it reports by default and by the whole Ω.
--park: Victoria Park instead, which has no ground truth: the distance of the aligned map from the
batch solution, against that of the EKF. A scan has two measurements there and a loop hundreds of
scans, and mean recovery decides: with the default of ten landmarks a scan most means lag behind,
and models are linearized at them. So SEIF runs with `passive` 10 and 150, all landmarks. The cost
of a step is in `benchmarks.scaling`.
"""

import argparse
import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.gate import Metric, report
from jaxslam import datasets, filters
from jaxslam.filters.information.marginals import blanket_marginals, whole_marginals
from jaxslam.math.gaussians import mahalanobis_squared
from jaxslam.simulation.scenarios import circle, cloister
from jaxslam.simulation.scenarios.view import BetweenRanges
from jaxslam.simulation.worlds import simulate

KEY = jax.random.key(0)
EVERY = 10  # steps between two looks at covariances


def driven(filter, start, log):
    """The states after each step; EVERY steps apart if there are that many."""

    def step(state, row):
        state, _ = filter.update(filter.predict(state, row.control, KEY), row.scan, KEY)
        return state, state.pose

    def block(state, rows):
        state, seen = jax.lax.scan(step, state, rows)
        return state, (state, seen)

    whole = len(log.control) // EVERY * EVERY
    rows = jax.tree.map(lambda x: x[:whole].reshape(-1, EVERY, *x.shape[1:]), log)
    final, (states, path) = jax.lax.scan(block, start, rows)
    return final, states, path.reshape(-1, 3)


def estimated_map(state):
    """Points (N, 2) by tag, which exist, and (pose_cov, point_covs) as reported and whole."""
    if hasattr(state, "links"):
        return state.landmarks, state.alive, (blanket_marginals(state), whole_marginals(state))
    count = len(state.tag)
    slot = jnp.argmax(state.tag[None, :] == jnp.arange(count)[:, None], axis=1)
    alive = (state.tag[None, :] == jnp.arange(count)[:, None]).any(axis=1)
    every = jnp.arange(count)
    covs = state.cov[3:, 3:].reshape(count, 2, count, 2)[every, :, every][slot]
    return state.landmarks[slot], alive, ((state.cov[:3, :3], covs),) * 2


def errors_and_nees(world, runs: int, candidates) -> dict[str, dict[str, float]]:
    """RMSE of position and of the map at the end, and NEES of pose and of the landmarks."""
    start = jnp.asarray(world.pose, float), jnp.asarray(world.pose_cov)

    def look(state, pose, landmarks):
        error = pose - state.pose
        error = error.at[2].set((error[2] + jnp.pi) % (2 * jnp.pi) - jnp.pi)
        points, alive, both = estimated_map(state)
        off = jnp.where(alive[:, None], landmarks - points, 0.0)
        nees = []
        for pose_cov, covs in both:
            of_map = jax.vmap(lambda e, c: mahalanobis_squared(e, c)[0])(off, covs)
            of_map = jnp.where(alive, of_map, 0.0).sum() / jnp.maximum(alive.sum(), 1)
            nees += [mahalanobis_squared(error, pose_cov)[0], of_map]
        return jnp.stack(nees), (off**2).sum() / jnp.maximum(alive.sum(), 1)

    def one(key, filter):
        truth, log = simulate(world, key)
        final, states, path = driven(filter, filter.init(*start), log)
        at = jnp.arange(EVERY - 1, len(path), EVERY)
        nees, square = jax.lax.map(
            lambda row: look(*row, truth.landmarks), (states, truth.pose[at])
        )
        position = ((path - truth.pose[: len(path)])[:, :2] ** 2).sum(axis=1).mean()
        return nees.mean(axis=0), square[-1], position, getattr(final, "counts", ())

    out = {}
    for name, filter in candidates.items():
        keys = jax.random.split(jax.random.key(7), runs)
        nees, square, position, counts = jax.jit(
            lambda k, f=filter: jax.lax.map(partial(one, filter=f), k)
        )(keys)
        nees = np.asarray(nees).mean(axis=0)
        out[name] = {
            "map RMSE [m]": float(np.sqrt(np.mean(square))),
            "position RMSE [m]": float(np.sqrt(np.mean(position))),
            "NEES pose, blanket": nees[0],
            "whole": nees[2],
            "NEES landmark, blanket": nees[1],
            "whole ": nees[3],
        }
        if counts:
            mean = {k: float(np.mean(v)) for k, v in counts._asdict().items()}
            out[name] |= {k: mean[k] for k in ("cut", "dropped", "refused")}
        row = "  ".join(f"{k} {v:.4g}" for k, v in out[name].items())
        print(f"  {name:18}{row}", flush=True)
    return out


def compared(world, runs, setups) -> dict[str, dict[str, float]]:
    """The EKF, and SEIF of each setup (active, links)."""
    count = len(world.landmarks)
    models = world.motion, world.sensor, count
    candidates = {"EKF": filters.EkfSlam(*models, correction="joint")}
    for active, links in setups:
        candidates[f"SEIF, {active} active"] = filters.Seif(*models, active=active, links=links)
    print(
        f"\n{world.name}, {runs} runs of {world.steps} steps; a consistent filter has a NEES of 3"
    )
    print("of a pose and 2 of a landmark; errors of linearization add to it, as to the EKF's")
    return errors_and_nees(world, runs, candidates)


def measure(runs: int = 10, steps: int = 300) -> list[Metric]:
    start = np.diag([0.01, 0.01, 0.005]) ** 2
    ring = dataclasses.replace(circle(steps), pose_cov=start)
    near = dataclasses.replace(
        cloister(steps), visible=BetweenRanges(0.0, 3.0), places=14, pose_cov=start
    )
    metrics = []
    # On circle 20 active are all there are, and SEIF is the EIF; so 8 as well, for the table.
    for name, world, setups in (
        ("circle", ring, [(20, 19), (8, 19)]),
        ("cloister", near, [(20, 35)]),
    ):
        table = compared(world, runs, setups)
        ekf = table["EKF"]["map RMSE [m]"]
        row = table["SEIF, 20 active"]
        share = row["map RMSE [m]"] / ekf
        metrics += [
            Metric(f"SEIF, 20 active, map RMSE by EKF's, {name}", share, high=1.1),
            Metric(f"SEIF, scans refused, {name}", row["refused"], high=0.0),
        ]
    return metrics


# --- Victoria Park -------------------------------------------------------------------------------


def park(path: str | None = None, active: int = 20, links: int = 150) -> list[Metric]:
    """The maps of SEIF against the EKF's, aligned and as they are."""
    import gtsam

    from benchmarks.victoria_park import Solution, compare, run_batch

    data = datasets.victoria_park(path or gtsam.findExampleDataFile("victoria_park.txt"))
    models = data.motion, data.sensor, data.capacity
    options = {"active": active, "links": links}
    all_means = {"passive": data.capacity, "sweeps": 3}
    candidates = {
        "EKF": filters.EkfSlam(*models, correction="joint"),
        "SEIF": filters.Seif(*models, **options),
        "SEIF, all means": filters.Seif(*models, **options, **all_means),
    }
    found, metrics = {}, []
    places = data.log.scan.tag.shape[1]
    print(f"\n{data.name}: {data.steps} steps, {data.capacity} landmarks, {places} places a scan,")
    print(f"{active} active, {links} links; from the EKF's map")
    for name, filter in candidates.items():
        start = filter.init(jnp.asarray(data.pose, float), jnp.asarray(data.pose_cov, float))
        drive = jax.jit(lambda log, f=filter, s=start: _final(f, s, log))
        state, path_ = drive(jax.tree.map(jnp.asarray, data.log))
        points, _, both = estimated_map(state)
        found[name] = Solution(np.asarray(path_), np.asarray(points))
        spread = [float(jnp.sqrt(jnp.linalg.det(pose[:2, :2]))) for pose, _ in both]
        apart = compare(found[name], found["EKF"])
        if name == "EKF":
            batch = run_batch(data, found[name]).solution
        from_batch = compare(found[name], batch)["map RMSE [m]"]
        apart["map RMSE from batch [m]"] = from_batch
        apart["map RMSE unaligned [m]"] = float(
            np.sqrt(((found[name].points - found["EKF"].points) ** 2).sum(axis=1).mean())
        )
        row = "  ".join(f"{k} {v:.3f}" for k, v in apart.items())
        ends = f"√|P| of position at the end {spread[0]:.4f} m², whole {spread[1]:.4f} m²"
        print(f"  {name:30}{row}  {ends}")
        if hasattr(state, "counts"):
            print(20 * " " + "  ".join(f"{k} {v:.5g}" for k, v in state.counts._asdict().items()))
        share = from_batch / compare(found["EKF"], batch)["map RMSE [m]"]
        if name != "EKF":
            high = 1.1 if "all means" in name else np.inf
            metrics.append(Metric(f"{name}, map RMSE by EKF's, Victoria Park", share, high=high))
    return metrics


def _final(filter, state, log):
    def step(state, row):
        state, _ = filter.update(filter.predict(state, row.control, KEY), row.scan, KEY)
        return state, state.pose

    return jax.lax.scan(step, state, log)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.seif")
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--park", nargs="?", const="", help="Victoria Park, of this file")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.park is not None:
        return report(park(options.park or None))
    metrics = measure(options.runs, options.steps)
    print()
    return report(metrics)


if __name__ == "__main__":
    raise SystemExit(main())
