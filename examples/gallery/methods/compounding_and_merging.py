"""Tacher's method: bearings are compounded with the robot's pose, merged, and counted."""

import jax
import numpy as np

import jaxslam
from jaxslam.math import se2
from jaxslam.math.uncertain_poses import Frame, compound, mahalanobis_squared, merge
from jaxslam.results.plot import COLORS, FAINT, INK, PAGE, panels_of, titled

jax.config.update("jax_enable_x64", True)
landmark, sigma = np.array([0.5, 4.0]), 0.1  # [m], [rad]
robots = [
    Frame(np.array(pose), np.diag([0.2, 0.2, 0.1]) ** 2)
    for pose in ([-3.0, 1.0, 0.1], [1.0, 0.0, 0.2], [4.2, 2.2, 0.6])
]


def sighting(robot, error):
    """The landmark in the robot's frame, from a bearing and a vague range; its heading is free."""
    r, phi = se2.polar_in_frame(robot.pose, landmark) + np.array([0.0, error])
    turn, cov = np.asarray(se2.rotation(phi)), np.diag([0.0, 0.0, 1e6])
    cov[:2, :2] = turn @ np.diag([0.4 * r, sigma * r]) ** 2 @ turn.T
    return Frame(np.array([r * np.cos(phi), r * np.sin(phi), -robot.pose[2]]), cov)


def show(axes, frame, color, text="", place=0, look="-"):
    """Draw the 2 σ ellipse of a frame's position, with a label at one of its points."""
    contour = jaxslam.plot.ellipse(frame.pose[:2], frame.cov[:2, :2], 2.0)
    axes.plot(*contour.T, look, color=color, lw=1.3)
    where = contour[place] + 0.4 * np.array([np.cos(place / 10.2), np.sin(place / 10.2)])
    axes.text(*where, text, color=color, fontsize=9, ha="center", va="center")


def wedge(axes):
    """The density of a landmark with bearing π/3 from the origin, over its largest value."""
    x, y = np.meshgrid(np.linspace(-4, 5, 181), np.linspace(-1, 8, 181))
    density = np.exp(-0.5 * ((np.arctan2(y, x) - np.pi / 3) / sigma) ** 2)
    axes.contourf(
        x, y, density, np.exp(-0.5 * np.array([3, 2.5, 2, 1.5, 1, 0.5, 0]) ** 2), cmap="Blues"
    )
    axes.plot(0, 0, "o", color=COLORS[0], ms=3.5)
    axes.set(xlabel="ahead of the robot [m]", ylabel="to its left [m]", aspect="equal")
    titled(axes, "(a) one bearing: density, steps of ½ σ")


def stage(axes, title, seen, shown):
    """The robots, their bearings, and estimates of the landmark."""
    for robot, of in seen:
        ray = compound(robot, of._replace(pose=of.pose * np.array([2.2, 2.2, 1.0]))).pose[:2]
        axes.plot(*np.stack([robot.pose[:2], ray]).T, color=FAINT, lw=0.8, ls=(0, (4, 2)))
        axes.plot(*robot.pose[:2], "o", color=COLORS[0], ms=3.5)
        show(axes, robot, COLORS[0])
    for each in shown:
        show(axes, *each)
    axes.plot(*landmark, "x", color=INK, ms=6, mew=1.4, zorder=5)
    axes.set(xlim=(-4, 5), ylim=(-1, 8), xlabel="x [m]", ylabel="y [m]", aspect="equal")
    titled(axes, title)


seen = [(robot, sighting(robot, e)) for robot, e in zip(robots, (0.05, 0.05, -0.08), strict=True)]
c1, c2, c4 = (compound(*pair) for pair in seen)
exact, c3 = compound(robots[0]._replace(cov=np.zeros((3, 3))), seen[0][1]), merge(c1, c2)[0]
c5, near = merge(c3, c4)[0], float(mahalanobis_squared(c3, c4)[0])
figure, panels = panels_of(PAGE, 7.2, 2, 2, share=(False, False))
wedge(panels[0])
for axes, *content in (
    (
        panels[1],
        "(b) compounded: $C_1$; dashed: exact pose",
        seen[:1],
        [(exact, COLORS[1], "", 0, "--"), (c1, COLORS[1], "$C_1$", 0)],
    ),
    (
        panels[2],
        "(c) two merged: $C_3$, persistence 1",
        seen[:2],
        [(c1, COLORS[1], "$C_1$", 0), (c2, COLORS[2], "$C_2$", 24), (c3, COLORS[3], "$C_3$", 34)],
    ),
    (
        panels[3],
        f"(d) $C_4$ at $d^2 = {near:.1f}$ merged: $C_5$, persistence 2",
        seen,
        [(c3, COLORS[3], "$C_3$", 40), (c4, COLORS[4], "$C_4$", 32), (c5, INK, "$C_5$", 4)],
    ),
):
    stage(axes, *content)
