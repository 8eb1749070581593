"""Averages of numbers that are correlated along one recording, with intervals.

z (n, d) are errors over their claimed deviations, and C_k = (1/n) Σ_t z_t z_{t+k}ᵀ, not centred: an
error that stays is one error, however often it is seen. `judge_recording` has the equations and
their sources.
"""

from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float

from jaxslam.consistency._intervals import LEVEL, Average
from jaxslam.math.stats import chi2_quantile, normal_quantile, t_quantile

_ORDERS = 30
"""Orders of the correlation of indicators; the shares of higher ones are taken for independent."""


def lagged_products(
    u: Float[np.ndarray, "n c"], s: Float[np.ndarray, "n d"]
) -> Float[np.ndarray, "n c d"]:
    """Σ_t u_t s_{t+k}ᵀ for each lag k from 0 to n - 1, by FFT."""
    size = scipy.fft.next_fast_len(2 * len(u), real=True)
    a, b = (scipy.fft.rfft(part, size, axis=0) for part in (u, s))
    lags = scipy.fft.irfft(a.conj()[:, :, None] * b[:, None, :], size, axis=0)
    return np.asarray(lags[: len(u)])


def correlation_length(z: Float[np.ndarray, "n d"]) -> int:
    """The number of poses over which errors are correlated: the first lag with tr Σ z zᵀ <= 0."""
    ends = np.trace(lagged_products(z, z), axis1=1, axis2=2) <= 0
    return int(np.argmax(ends)) if ends.any() else len(z)


def long_run(
    u: Float[np.ndarray, "n c"], s: Float[np.ndarray, "n d"], length: int
) -> Float[np.ndarray, "c d"]:
    """The covariance of Σ u and Σ s: Σ_t u_t s_{t+k}ᵀ over lags |k| below a length."""
    after, before = lagged_products(u, s)[:length], lagged_products(s, u)[1:length]
    return np.asarray(after.sum(axis=0) + before.sum(axis=0).T)


class MeanSquare(NamedTuple):
    """The mean q̄ of q = zᵀz over n poses, and how far its expectation may be away."""

    average: Average
    nu: float
    """effective degrees of freedom: ν q̄/E q ~ χ²_ν"""
    r: Float[np.ndarray, "K"]
    """correlation of q_t and q_{t+k}, of Gaussian errors, from k = 0 to where it ends"""
    excess: float
    """variance of q̄ over that of Gaussian errors, and what its estimate adds to the interval"""


def mean_square(z: Float[np.ndarray, "n d"], absorbed: float = 0.0) -> MeanSquare:
    """The mean square of errors z that are correlated; see `judge_recording`.

    absorbed: share of zᵀz that an alignment has taken from all of them alike, if above 0.
    """
    count, dof = z.shape
    q = (z**2).sum(axis=1)
    mean = float(q.mean())
    if not mean > 0:
        return MeanSquare(Average(mean, 0.0, np.inf), 1.0, np.ones(1), 1.0)
    before = mean / (1 - np.clip(absorbed, 0.0, 0.9))  # the alignment
    products = lagged_products(z, z) / count + (before - mean) / dof * np.eye(dof)
    square = np.trace(products, axis1=1, axis2=2) ** 2
    size = (products**2).sum(axis=(1, 2))
    # The expectation of |C_k|² of errors that are independent at lag k, and correlated at the lags
    # below it (Bartlett 1946)
    noise = (2 * (np.cumsum(square) - square) - square[0]) / count
    noise[0] = 0.0
    is_noise = size <= noise
    length = int(np.argmax(is_noise)) if is_noise.any() else count
    # Without that noise of its d² entries |C_k|² is at least (tr C_k)²/d, by Cauchy and Schwarz.
    size = np.maximum(size[:length] - noise[length - 1], square[:length] / dof)
    size[0] = (products[0] ** 2).sum()
    gaussian = 2 * float(size[0] + 2 * size[1:].sum())
    centred = (q - mean)[:, None]
    excess = max(1.0, float(long_run(centred, centred, length)[0, 0]) / count / gaussian)
    nu = float(np.clip(2 * count * before**2 / (excess * gaussian), 1.0, count * dof))
    # Of n/2K stretches; Student's t in place of the normal
    half = t_quantile((1 + LEVEL) / 2, max(count / (2 * length), 1.0))
    shrunk = (normal_quantile((1 + LEVEL) / 2) / half) ** 2
    fewer = max(nu * shrunk, 1.0)
    low, high = (fewer * mean / chi2_quantile(p, fewer) for p in ((1 + LEVEL) / 2, (1 - LEVEL) / 2))
    return MeanSquare(Average(mean, low, high), nu, size / size[0], excess / shrunk)


def share_within(
    inside: Bool[np.ndarray, "n"], level: float, dof: int, nees: MeanSquare
) -> Average:
    """The share of poses within an ellipsoid of a level, with its interval of Jeffreys.

    Two χ²_d numbers with correlation r have the joint density f f' Σ_m r^m L_m L_m', with L_m the
    normalized polynomials of Laguerre (Kibble 1941, "A two-variate gamma type distribution",
    Sankhyā 5). So the indicators of q <= χ²_d(p) have the correlation Σ_m w_m r^m, w_m the share of
    their variance of order m, and as many independent ones have the same spread.
    """
    c, a = chi2_quantile(level, dof) / 2, dof / 2
    m = np.arange(1, _ORDERS + 1)
    gammaln = scipy.special.gammaln
    # ∫ f L_m over [0, c], and the square of the norm of L_m
    integral = np.exp(a * np.log(c) - c - gammaln(a)) / m
    integral *= scipy.special.eval_genlaguerre(m - 1, a, c)
    norm = np.exp(gammaln(m + a) - gammaln(m + 1) - gammaln(a))
    weight = integral**2 / norm / (level * (1 - level))
    sums = np.array([(nees.r[1:] ** order).sum() for order in m])
    independent = max(len(inside) / (1 + 2 * float(weight @ sums)) / nees.excess, 1.0)
    share = float(inside.mean())
    shape = independent * share + 0.5, independent * (1 - share) + 0.5
    low, high = (
        float(scipy.special.betaincinv(*shape, p)) for p in ((1 - LEVEL) / 2, (1 + LEVEL) / 2)
    )
    # Of none or all, the end that is sure (Brown, Cai & DasGupta 2001).
    return Average(share, low if share > 0 else 0.0, high if share < 1 else 1.0)


def mean_of(values: Float[np.ndarray, "n"]) -> Average:
    """The mean of correlated numbers with its t interval."""
    mean = float(values.mean())
    error, dof = error_of_sum((values - mean)[:, None])
    half = t_quantile(0.5 + LEVEL / 2, dof) * error / len(values)
    return Average(mean, mean - half, mean + half)


def error_of_sum(scores: Float[np.ndarray, "n 1"]) -> tuple[float, float]:
    """The standard error of a sum of correlated numbers of mean 0, and its degrees of freedom."""
    total = float((scores**2).sum())
    if not total > 0:
        return 0.0, 1.0
    length = correlation_length(scores)
    variance = max(float(long_run(scores, scores, length)[0, 0]), total)
    return float(np.sqrt(variance)), max(len(scores) / (2 * length), 1.0)
