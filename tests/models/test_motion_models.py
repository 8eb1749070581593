"""odometry, velocity and ackermann against formulas in plain NumPy, written from their equations.

What every motion model owes is in conformance/test_motion.py; here is what each one is.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import refused
from reference.plane import assert_same_poses, matrix, pose_of, wrap

from jaxslam.motion import (
    Ackermann,
    Odometry,
    OdometryNoise,
    Velocity,
    VelocityNoise,
    odometry_control,
)

NO_NOISE = {2: np.zeros((2, 2)), 3: np.zeros((3, 3))}


def random_poses(rng, count):
    return np.column_stack([rng.normal(size=(count, 2)) * 3, rng.uniform(-np.pi, np.pi, count)])


def batched(function):
    return jax.jit(jax.vmap(function))


# --- odometry -----------------------------------------------------------------------------------

drive = batched(Odometry(NO_NOISE[3]).step)
control_between = batched(odometry_control)


def notes_odometry(before, after):
    """(rot1, trans, rot2) from the Notes' three relations."""
    (x, y, theta), (x1, y1, theta1) = before.T, after.T
    rot1 = np.arctan2(y1 - y, x1 - x) - theta
    return np.stack([rot1, np.sqrt((x1 - x) ** 2 + (y1 - y) ** 2), theta1 - theta - rot1], axis=1)


def test_odometry_turns_drives_and_turns():
    rng = np.random.default_rng(0)
    pose, u, w = random_poses(rng, 50), rng.normal(size=(50, 3)) * 3, rng.normal(size=(50, 3))
    rot1, trans, rot2 = (u + w).T
    heading = pose[:, 2] + rot1
    expected = [pose[:, 0] + trans * np.cos(heading), pose[:, 1] + trans * np.sin(heading)]
    assert_same_poses(drive(pose, u, w), np.stack([*expected, heading + rot2], axis=1))


def test_odometry_control_is_the_notes_relations_and_leads_from_pose_to_pose():
    rng = np.random.default_rng(1)
    before, after = random_poses(rng, 200), random_poses(rng, 200)
    u = np.asarray(control_between(before, after))
    expected = notes_odometry(before, after)
    np.testing.assert_allclose(u[:, 1], expected[:, 1], atol=1e-13)
    np.testing.assert_allclose(wrap(u - expected)[:, [0, 2]], 0, atol=1e-13)
    assert np.all(u[:, [0, 2]] > -np.pi) and np.all(u[:, [0, 2]] <= np.pi)
    assert_same_poses(drive(before, u, 0 * u), after)


def test_odometry_control_recovers_the_control():
    rng = np.random.default_rng(2)
    pose, u = random_poses(rng, 100), rng.uniform(-np.pi, np.pi, (100, 3))
    u[:, 1] = np.abs(u[:, 1]) + 0.01
    back = control_between(pose, drive(pose, u, 0 * u))
    np.testing.assert_allclose(back, u, atol=1e-12)


def test_driving_backwards_is_half_a_turn_before_and_after():
    rng = np.random.default_rng(3)
    pose, distance = random_poses(rng, 50), rng.uniform(0.1, 2, 50)
    u = np.stack([0 * distance, -distance, 0 * distance], axis=1)
    after = drive(pose, u, 0 * u)
    back = np.asarray(control_between(pose, after))
    np.testing.assert_allclose(np.abs(back[:, [0, 2]]), np.pi, atol=1e-12)
    np.testing.assert_allclose(back[:, 1], distance, atol=1e-12)
    assert_same_poses(drive(pose, back, 0 * u), after)
    # arctan2(-0, -1) is -π, which is no wrapped angle
    exact = odometry_control(jnp.array([0.0, 0.0, -0.0]), jnp.array([-1.0, -0.0, 0.0]))
    assert exact[0] == np.pi and exact[2] == np.pi


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_odometry_control_without_translation_is_the_turn_with_finite_derivatives(dtype):
    rng = np.random.default_rng(4)
    before = random_poses(rng, 20)
    after = before.copy()
    after[:, 2] = wrap(rng.uniform(-9, 9, 20))
    after[0] = before[0]
    before, after = before.astype(dtype), after.astype(dtype)
    u = np.asarray(control_between(before, after))
    assert u.dtype == dtype
    assert np.all(u[:, :2] == 0)
    atol = 8 * np.finfo(dtype).eps
    np.testing.assert_allclose(wrap(u[:, 2] - (after - before)[:, 2]), 0, atol=atol)
    forward = batched(jax.jacfwd(odometry_control, argnums=(0, 1)))(before, after)
    reverse = batched(jax.jacrev(odometry_control, argnums=(0, 1)))(before, after)
    for a, b in zip(forward, reverse, strict=True):
        assert a.dtype == dtype and np.isfinite(a).all()
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(forward[1][:, 2, 2], 1)


def odometry_variances(alpha, u):
    a1, a2, a3, a4 = alpha
    rot1, trans, rot2 = u
    return [
        a1 * rot1**2 + a2 * trans**2,
        a3 * trans**2 + a4 * (rot1**2 + rot2**2),
        a1 * rot2**2 + a2 * trans**2,
    ]


def velocity_variances(alpha, u):
    v, omega, _ = u
    return [alpha[i] * v**2 + alpha[i + 1] * omega**2 for i in (0, 2, 4)]


# factory of the covariance, its plain form, the model it is made for, how many constants
NOISES = {
    "odometry": (OdometryNoise, odometry_variances, Odometry, 4),
    "velocity": (VelocityNoise, velocity_variances, Velocity, 6),
}


@pytest.mark.parametrize("name", NOISES)
def test_covariance_from_alpha_is_the_books_table(name):
    noise, variances, model, count = NOISES[name]
    rng = np.random.default_rng(5)
    alpha = rng.uniform(0.01, 0.2, count)
    pose, u = random_poses(rng, 20), rng.normal(size=(20, 3))
    expected = np.stack([np.diag(variances(alpha, one)) for one in u])
    cov = batched(model(noise(alpha)).noise_cov)
    np.testing.assert_allclose(cov(pose, u), expected, rtol=1e-14)
    single = cov(pose.astype("f4"), u.astype("f4"))
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, expected, rtol=1e-6)
    np.testing.assert_array_equal(cov(pose, 0 * u), 0)


@pytest.mark.parametrize("name", NOISES)
def test_gradients_reach_alpha(name):
    """The covariance is linear in α: its slope by α_k is the covariance of α = e_k."""
    noise, variances, model, count = NOISES[name]
    rng = np.random.default_rng(6)
    pose, u, weights = random_poses(rng, 1)[0], rng.normal(size=3), rng.normal(size=3)

    def total(alpha):
        return jnp.sum(jnp.diagonal(model(noise(alpha)).noise_cov(pose, u)) * weights)

    expected = [np.dot(variances(one, u), weights) for one in np.eye(count)]
    slope = jax.jit(jax.grad(total))
    np.testing.assert_allclose(slope(np.zeros(count)), expected, rtol=1e-13)
    # Some of the constants may be traced, the others not.
    part = jax.jit(jax.grad(lambda a: total([a, *[0.1] * (count - 1)])))(0.2)
    np.testing.assert_allclose(part, expected[0], rtol=1e-13)


@pytest.mark.parametrize("name", NOISES)
@pytest.mark.parametrize(
    "spoil",
    [
        lambda a: a[:-1],
        lambda a: np.append(a, 0.1),
        lambda a: a[None],
        lambda a: 0.1,
        lambda a: None,
        lambda a: np.where(np.arange(len(a)) == 1, -1e-9, a),
        lambda a: np.where(np.arange(len(a)) == 1, np.nan, a),
        lambda a: np.where(np.arange(len(a)) == 1, np.inf, a),
        lambda a: a * 1j,
        lambda a: ["a"] * len(a),
    ],
    ids=["few", "many", "matrix", "scalar", "none", "negative", "nan", "inf", "complex", "text"],
)
def test_bad_alphas_are_refused(name, spoil):
    noise, _, _, count = NOISES[name]
    bad = spoil(np.full(count, 0.1))
    with pytest.raises(ValueError, match=f"^{name.title()}Noise: .*alpha"):
        noise(bad)
    if np.shape(bad) != (count,) and bad is not None:
        with pytest.raises(ValueError, match=f"^{name.title()}Noise: .*alpha"):
            jax.eval_shape(lambda a: noise(a)(np.zeros(3), np.zeros(3)), np.asarray(bad))


# --- velocity -----------------------------------------------------------------------------------

VELOCITY = Velocity(NO_NOISE[3])
move = batched(VELOCITY.step)


def arc(pose, v, omega, dt, gamma=0.0):
    """The Notes' velocity model as the errata have it, ω ≠ 0."""
    x, y, theta = pose.T
    turned = theta + omega * dt
    return np.stack(
        [
            x - v / omega * np.sin(theta) + v / omega * np.sin(turned),
            y + v / omega * np.cos(theta) - v / omega * np.cos(turned),
            turned + gamma * dt,
        ],
        axis=1,
    )


def test_velocity_is_the_notes_arc_and_final_rotation():
    rng = np.random.default_rng(7)
    pose, u, w = random_poses(rng, 200), rng.normal(size=(200, 3)) * 2, rng.normal(size=(200, 3))
    (v, omega), dt = (u + w).T[:2], u[:, 2]
    far = np.abs(omega) > 0.05  # where v/ω loses no more than two digits
    assert far.sum() > 150
    expected = arc(pose, v, omega, dt, w[:, 2])
    assert_same_poses(move(pose, u, w)[far], expected[far], 1e-11)


def test_velocity_without_turn_is_a_straight_line():
    rng = np.random.default_rng(8)
    pose, u = random_poses(rng, 20), rng.normal(size=(20, 3))
    u[:, 1] = 0
    way = u[:, :1] * u[:, 2:]
    ahead = np.stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])], axis=1)
    expected = np.concatenate([pose[:, :2] + way * ahead, pose[:, 2:]], axis=1)
    assert_same_poses(move(pose, u, 0 * u), expected, 1e-14)
    assert_same_poses(move(expected, u * [-1, 1, 1], 0 * u), pose, 1e-14)


def test_the_final_rotation_turns_and_moves_nothing():
    rng = np.random.default_rng(9)
    pose, u, w = random_poses(rng, 20), rng.normal(size=(20, 3)), rng.normal(size=(20, 3)) * 3
    with_it, without = np.asarray(move(pose, u, w)), np.asarray(move(pose, u, w * [1, 1, 0]))
    np.testing.assert_array_equal(with_it[:, :2], without[:, :2])
    np.testing.assert_allclose(
        wrap(with_it[:, 2] - without[:, 2] - w[:, 2] * u[:, 2]), 0, atol=1e-14
    )


# Through zero turn, and beside the two angles at which a power series ends: 0.5 for sin(x)/x, and
# 0.5 for its half angle in (1 - cos x)/x.
TURNS = np.array(
    [0.0, 1e-9, 1e-6, 1e-4, 1e-2, 0.4999999, 0.5, 0.5000001, 0.51, 0.9999999, 1.0, 1.0000001, 1.1]
)
TURNS = np.concatenate([-TURNS[:0:-1], TURNS])


def by_quadrature(pose, u, w):
    """Value (3,), Jacobian (3, 9) and second derivatives (3, 9, 9) of velocity's step, exactly.

    The position is the integral of the velocity along the arc, with nothing singular in it:

        x + iy + ∫₀¹ A exp(iΦ(s)) ds,    A = v̂Δt,  Φ = θ + s ω̂Δt

    and so are its derivatives. 24 Gauss points leave no error for turns of a radian. By the
    arguments (x, y, θ, v, ω, Δt, w_v, w_ω, w_γ).
    """
    (x, y, theta), (v, omega, dt), (w_v, w_omega, w_gamma) = pose, u, w
    v, omega = v + w_v, omega + w_omega
    first, second = np.zeros(9, complex), np.zeros((9, 9), complex)
    position = x + 1j * y
    first[:2] = 1, 1j
    grad_a, hess_a = np.zeros(9), np.zeros((9, 9))
    grad_a[[3, 6]], grad_a[5] = dt, v
    hess_a[[3, 6], 5] = hess_a[5, [3, 6]] = 1
    nodes, weights = np.polynomial.legendre.leggauss(24)
    for s, weight in zip((nodes + 1) / 2, weights / 2, strict=True):
        grad_p, hess_p = np.zeros(9), np.zeros((9, 9))
        grad_p[2], grad_p[[4, 7]], grad_p[5] = 1, s * dt, s * omega
        hess_p[[4, 7], 5] = hess_p[5, [4, 7]] = s
        a, wave = v * dt, weight * np.exp(1j * (theta + s * omega * dt))
        cross = np.outer(grad_a, grad_p)
        position += a * wave
        first += (grad_a + 1j * a * grad_p) * wave
        second += (hess_a + 1j * (cross + cross.T)) * wave
        second += a * (1j * hess_p - np.outer(grad_p, grad_p)) * wave
    turn, turn_hess = np.zeros(9), np.zeros((9, 9))
    turn[2], turn[5], turn[[4, 7, 8]] = 1, omega + w_gamma, dt
    turn_hess[[4, 7, 8], 5] = turn_hess[5, [4, 7, 8]] = 1
    return (
        np.array([position.real, position.imag, theta + (omega + w_gamma) * dt]),
        np.stack([first.real, first.imag, turn]),
        np.stack([second.real, second.imag, turn_hess]),
    )


def of_nine(arguments):
    return VELOCITY.step(arguments[:3], arguments[3:6], arguments[6:])


@batched
def two_derivatives(arguments):
    slope = jax.jacfwd(of_nine)
    return of_nine(arguments), slope(arguments), jax.jacfwd(slope)(arguments)


# Rounding errors of the value, the Jacobian and the second derivatives that are let pass, in ulps of
# the largest entry.
ULPS = {np.float32: (3, 6, 12), np.float64: (6, 15, 40)}


@pytest.mark.parametrize("noise", [False, True], ids=["turn by control", "turn by noise"])
@pytest.mark.parametrize("dtype", ULPS)
def test_value_and_two_derivatives_go_smoothly_through_zero_turn(dtype, noise):
    """By every argument."""
    cases = np.zeros((len(TURNS), 9))
    cases[:, :6] = 0.3, -0.2, 0.4, 1.5, 0.0, 1.0
    cases[:, 7 if noise else 4] = TURNS
    cases[:, 8] = 0.1
    cases = cases.astype(dtype)
    out = two_derivatives(cases)
    exact = [by_quadrature(a[:3], a[3:6], a[6:]) for a in cases.astype(np.float64)]
    for order, (actual, ulps) in enumerate(zip(out, ULPS[dtype], strict=True)):
        expected = np.stack([e[order] for e in exact])
        assert actual.dtype == dtype
        atol = ulps * np.finfo(dtype).eps * np.abs(expected).max()
        np.testing.assert_allclose(actual, expected, rtol=0, atol=atol)
        # Between neighbours the rise is what a slope allows: nothing jumps.
        rise = np.abs(np.diff(np.asarray(actual, np.float64), axis=0))
        rise = rise.reshape(len(rise), -1).max(axis=1)
        assert np.all(rise <= 3 * np.diff(TURNS) + 2 * atol)


# --- ackermann ----------------------------------------------------------------------------------

L, A, B, H = 2.83, 3.78, 0.5, 0.76
steer = batched(Ackermann(NO_NOISE[2]).step)


def rear_axle(pose, sensor=(A, B)):
    return pose_of(matrix(pose) @ np.linalg.inv(matrix([*sensor, 0])))


def speeds(u, wheelbase=L, encoder=H):
    """Speed of the axle's centre, and turn rate."""
    v = u[0] / (1 - encoder / wheelbase * np.tan(u[1]))
    return v, v * np.tan(u[1]) / wheelbase


def car_on_an_arc(pose, u, wheelbase=L, sensor=(A, B), encoder=H):
    """The rear axle moves along its circle and carries the sensor along."""
    v, omega = speeds(u, wheelbase, encoder)
    axle = arc(rear_axle(pose, sensor)[None], v, omega, u[2])[0]
    return pose_of(matrix(axle) @ matrix([*sensor, 0]))


def guivant_nebot_rate(pose, u):
    """Their equations for the laser's pose, over Δt."""
    (v, _), phi, tan = speeds(u), pose[2], np.tan(u[1])
    return np.array(
        [
            v * np.cos(phi) - v / L * tan * (A * np.sin(phi) + B * np.cos(phi)),
            v * np.sin(phi) + v / L * tan * (A * np.cos(phi) - B * np.sin(phi)),
            v / L * tan,
        ]
    )


def car_cases(seed, count):
    rng = np.random.default_rng(seed)
    steering = rng.uniform(0.1, 0.9, count) * rng.choice([-1, 1], count)
    u = np.stack([rng.normal(size=count) * 4, steering, rng.uniform(0.02, 1.5, count)], axis=1)
    return random_poses(rng, count), u, np.zeros((count, 2))


def test_the_car_turns_about_its_rear_axle():
    pose, u, w = car_cases(11, 100)
    w = w + np.random.default_rng(12).normal(size=w.shape) * 0.02
    noisy = u + np.column_stack([w, np.zeros(len(w))])
    expected = np.stack([car_on_an_arc(p, c) for p, c in zip(pose, noisy, strict=True)])
    assert_same_poses(steer(pose, u, w), expected, 1e-11)


def test_other_cars_too():
    """The sensor behind and to the right, the encoder on the right."""
    car = {"wheelbase": 1.2, "sensor": (-0.4, -0.7), "encoder": -0.3}
    pose, u, w = car_cases(13, 50)
    expected = np.stack([car_on_an_arc(p, c, **car) for p, c in zip(pose, u, strict=True)])
    actual = batched(Ackermann(NO_NOISE[2], **car).step)(pose, u, w)
    assert_same_poses(actual, expected, 1e-11)


def test_its_euler_step_is_the_published_model():
    """The slope by Δt at Δt = 0 is Guivant & Nebot's, signs of a and b included."""
    pose, u, w = car_cases(14, 50)
    u[:, 2] = 0
    slope = batched(jax.jacfwd(Ackermann(NO_NOISE[2]).step, argnums=1))(pose, u, w)[:, :, 2]
    expected = [guivant_nebot_rate(p, c) for p, c in zip(pose, u, strict=True)]
    np.testing.assert_allclose(slope, expected, rtol=1e-12, atol=1e-13)


def test_straight_ahead_every_point_of_the_car_moves_alike():
    pose, u, w = car_cases(16, 20)
    u[:, 1] = 0
    way = u[:, 0] * u[:, 2]
    expected = pose + np.stack(
        [way * np.cos(pose[:, 2]), way * np.sin(pose[:, 2]), 0 * way], axis=1
    )
    assert_same_poses(steer(pose, u, w), expected, 1e-13)


def test_the_encoders_wheel_rolls_as_far_as_it_says():
    """It stands H to the left of the axle's centre; along its own circle it goes v_e Δt."""
    pose, u, w = car_cases(18, 50)
    after = np.asarray(steer(pose, u, w))
    wheel = matrix([0, H, 0])
    ends = [
        np.stack([pose_of(matrix(rear_axle(p)) @ wheel) for p in poses]) for poses in (pose, after)
    ]
    chord = np.linalg.norm(ends[1][:, :2] - ends[0][:, :2], axis=1)
    turn = np.array([speeds(c)[1] * c[2] for c in u])
    rolled = np.abs(u[:, 0] * u[:, 2] * 2 / turn * np.sin(turn / 2))
    np.testing.assert_allclose(chord, rolled, rtol=1e-10, atol=1e-12)


def test_gradients_reach_the_cars_lengths():
    pose, u, w = (a[0] for a in car_cases(19, 1))
    weights = np.array([1.0, -2.0, 0.5])

    def total(wheelbase, sensor, encoder):
        return jnp.dot(Ackermann(NO_NOISE[2], wheelbase, sensor, encoder).step(pose, u, w), weights)

    slopes = jax.jit(jax.grad(total, argnums=(0, 1, 2)))(L, np.array([A, B]), H)
    cars = [[L, A, B, H]]
    for k in range(4):
        for sign in (1, -1):
            cars.append([L, A, B, H])
            cars[-1][k] += sign * 1e-5
    values = [np.dot(car_on_an_arc(pose, u, base, (a, b), h), weights) for base, a, b, h in cars]
    rises = np.array(values[1::2]) - values[2::2]
    np.testing.assert_allclose(
        np.concatenate([np.ravel(s) for s in slopes]), rises / 2e-5, rtol=1e-8
    )
    # One of the sensor's two lengths may be traced, the other not.
    part = jax.jit(jax.grad(lambda a: total(L, (a, B), H)))(A)
    np.testing.assert_allclose(part, slopes[1][0], rtol=1e-12)


@refused(
    ({"wheelbase": 0.0}, "wheelbase"),
    ({"wheelbase": -2.83}, "wheelbase"),
    ({"wheelbase": np.nan}, "wheelbase"),
    ({"wheelbase": np.inf}, "wheelbase"),
    ({"wheelbase": (2.83,)}, "wheelbase"),
    ({"wheelbase": None}, "wheelbase"),
    ({"sensor": (3.78,)}, "sensor"),
    ({"sensor": (3.78, 0.5, 0.0)}, "sensor"),
    ({"sensor": 3.78}, "sensor"),
    ({"sensor": (3.78, np.nan)}, "sensor"),
    ({"sensor": (3.78, 0.5j)}, "sensor"),
    ({"encoder": np.inf}, "encoder"),
    ({"encoder": (0.76, 0.0)}, "encoder"),
    ({"encoder": "left"}, "encoder"),
    told="^Ackermann: .*",
)
def test_impossible_cars_are_refused(bad):
    Ackermann(np.eye(2), **bad)


def test_traced_lengths_are_checked_for_their_shape():
    def build(**lengths):
        model = Ackermann(NO_NOISE[2], **lengths)
        return model.step(np.zeros(3), np.ones(3), np.zeros(2))

    for name, shape in (("wheelbase", (1,)), ("sensor", (3,)), ("encoder", (2,))):
        with pytest.raises(ValueError, match=f"^Ackermann: .*{name}"):
            jax.eval_shape(build, **{name: np.zeros(shape)})
