"""Why inverse depth: the bearing's linearity index, `python -m benchmarks.linearity [--out PNG]`.

A landmark is seen first from the origin, straight ahead, with a Gaussian on the guide's interval of
inverse distance, 0 to 1/d_min (Solà (47)): 1/(2 d_min) ± 1/(4 d_min), or the same as a range, to
first order. How far does the second bearing, from a robot that went a baseline sideways, bend
within 3 σ of that prior?
"""

import argparse
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam import sensors
from jaxslam.results.plot.style import COLUMN, INK, TEXT, caption, look, panels_of, png
from jaxslam.verify.linearity import sensor_linearity

NEAREST = 1.0
RHO, SIGMA = 0.5 / NEAREST, 0.25 / NEAREST
FIGURE = Path(__file__).parent / "figures" / "linearity.png"


def indices(sensor, landmark, column: int, sigma: float, baselines):
    """By the Hessian and by sampling, (B,) each, with one uncertain coordinate of the landmark."""
    cov = np.zeros((3 + len(landmark), 3 + len(landmark)))
    cov[3 + column, 3 + column] = sigma**2

    def one(baseline):
        pose = jnp.stack([0.0, baseline, 0.0])
        return sensor_linearity(sensor, pose, landmark, cov)

    out = jax.jit(jax.vmap(one))(baselines)
    return np.asarray(out.hessian), np.asarray(out.sampled)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.linearity")
    parser.add_argument("--out", type=Path, default=FIGURE)
    options = parser.parse_args()
    shares = np.geomspace(0.01, 3, 60)
    ask = partial(indices, baselines=shares * NEAREST)
    inverse = sensors.BearingInverseDepth([[1e-4]], min_distance=NEAREST)
    curves = {
        "range d": ask(sensors.BearingOnly([[1e-4]]), np.array([1 / RHO, 0.0]), 0, SIGMA / RHO**2),
        "inverse depth ρ": ask(inverse, np.array([0.0, 0.0, 0.0, RHO]), 3, SIGMA),
    }
    print(f"{'baseline / d_min':>18}" + "".join(f"{name:>18}" for name in curves))
    for share in (0.02, 0.1, 0.25, 0.5, 1.0, 3.0):
        i = int(np.argmin(np.abs(shares - share)))
        print(f"{shares[i]:18.3f}" + "".join(f"{c[0][i]:18.4f}" for c in curves.values()))

    figure, (axes,) = panels_of(COLUMN, 2.6, 1)
    for i, (name, (hessian, sampled)) in enumerate(curves.items()):
        line = look(i)
        axes.loglog(shares, hessian, color=line["color"], ls=line["ls"], label=f"{name}, Hessian")
        line["ls"] = "none"
        axes.loglog(shares[::4], sampled[::4], ms=3.6, label=f"{name}, sampled", **line)
    axes.axhline(1.0, color=INK, lw=0.8)
    axes.text(shares[0], 0.8, "above: bends farther than it rises", fontsize=TEXT, va="top")
    axes.set_xlabel("baseline / nearest distance")
    caption(figure, "Linearity index of the bearing (3 σ)")
    options.out.write_bytes(png(figure))
    print(f"wrote {options.out}")
    return 0


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    raise SystemExit(main())
