"""Resampling methods, and two that make a method differentiable.

Soft resampling draws from flattened weights; its gradient is biased. The weights of stop-gradient
resampling have the value 1/P, and the score of the draw as their gradient.
"""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxslam.core._record import field, function_of, record
from jaxslam.core.protocols import Resample
from jaxslam.core.validation import in_range
from jaxslam.math._arrays import Number
from jaxslam.resampling._weights import at_points, even, normalize, weights_of


def multinomial(log_weights: Float[Array, "P"], key: Array) -> Int[Array, "P"]:
    """Ancestors (P,) by multinomial resampling: P independent draws with P(a_i = j) = w_j.

    The number of copies of j has mean P w_j and variance P w_j (1 - w_j) (Gordon, Salmond & Smith
    1993, "Novel approach to nonlinear/non-Gaussian Bayesian state estimation", IEE Proc. F 140(2)).

    Args:
        log_weights: of any scale; non-finite ones are never drawn, unless none is finite.
        key: a PRNG key, consumed.
    """
    weights = weights_of(log_weights)
    return at_points(weights, jax.random.uniform(key, weights.shape, weights.dtype))


def residual(log_weights: Float[Array, "P"], key: Array) -> Int[Array, "P"]:
    """Ancestors (P,) by residual resampling: ⌊P w_j⌋ copies of each j, then random draws.

    The R = P - Σ ⌊P w_j⌋ draws are independent with probabilities (P w_j - ⌊P w_j⌋)/R.

    Unbiased as `multinomial`, with less variance (Liu & Chen 1998, "Sequential Monte Carlo methods
    for dynamic systems", JASA 93(443)). The copies come first, ascending.

    Args:
        log_weights: of any scale; non-finite ones are never drawn, unless none is finite.
        key: a PRNG key, consumed.
    """
    weights = weights_of(log_weights)
    count = weights.shape[0]
    share = count * weights
    # P·(1/P) may be rounded to less than 1.
    copies = jnp.floor(share * (1 + 4 * float(jnp.finfo(share.dtype).eps)))
    rest = jnp.maximum(share - copies, 0.0)
    index = jnp.arange(count)
    copied = jnp.searchsorted(jnp.cumsum(copies), index.astype(share.dtype), side="right")
    drawn = at_points(rest, jax.random.uniform(key, (count,), weights.dtype))
    return jnp.where(index < copies.sum(), copied, drawn).astype(jnp.int32)


def stratified(log_weights: Float[Array, "P"], key: Array) -> Int[Array, "P"]:
    """Ancestors (P,) by stratified resampling, ascending: those of the points (i + u_i)/P.

    The u_i are uniform in [0, 1) and independent.

    Unbiased as `multinomial`; the number of copies of j is within 2 of P w_j (Kitagawa 1996, "Monte
    Carlo filter and smoother for non-Gaussian nonlinear state space models", JCGS 5(1)).

    Args:
        log_weights: of any scale; non-finite ones are never drawn, unless none is finite.
        key: a PRNG key, consumed.
    """
    weights = weights_of(log_weights)
    count = weights.shape[0]
    u = jax.random.uniform(key, (count,), weights.dtype)
    return at_points(weights, (jnp.arange(count, dtype=u.dtype) + u) / count)


def systematic(log_weights: Float[Array, "P"], key: Array) -> Int[Array, "P"]:
    """Ancestors (P,) by systematic resampling, ascending: those of the points (i + u)/P.

    One u, uniform in [0, 1), is drawn for all i.

    The number of copies of j is P w_j rounded down or up, with mean P w_j: no particle of at least
    an even weight is lost (Carpenter, Clifford & Fearnhead 1999, "Improved particle filter for
    nonlinear problems", IEE Proc. Radar Sonar Navig. 146(1)).

    Args:
        log_weights: of any scale; non-finite ones are never drawn, unless none is finite.
        key: a PRNG key, consumed.
    """
    weights = weights_of(log_weights)
    count = weights.shape[0]
    u = jax.random.uniform(key, (), weights.dtype)
    return at_points(weights, (jnp.arange(count, dtype=u.dtype) + u) / count)


@record
class Soft:
    """Soft resampling: draws from a mixture of the weights and the uniform distribution.

    Karkus, Hsu & Lee 2018, "Particle filter networks with application to visual localization",
    CoRL:

        q_j = share · w_j + (1 - share)/P        weight of a copy of j: (w_j/q_j)/P

    The weights of the copies are divided by their sum, as a number; gradients go through w_j/q_j.

    **Biased**: expectations are correct, but the draws from q depend on the parameters too, and
    the gradient ignores this. share = 1 is plain resampling, whose copies all have weight 1/P and
    pass no gradient; share = 0 has an unbiased gradient, and does not resample by weight.
    `StopGradient` is unbiased for any method.

    Raises ValueError on a share outside [0, 1].
    """

    share: Number = field(check=in_range(0.0, 1.0))
    """share of the weights in the mixture, 0 to 1"""
    resample: Resample = field(default=systematic, check=function_of("log_weights", "key"))
    """method that draws the indices from q"""

    def __call__(
        self, log_weights: Float[Array, "P"], key: Array
    ) -> tuple[Int[Array, "P"], Float[Array, "P"]]:
        log_w = normalize(log_weights)[0]
        w = jnp.exp(log_w)
        share = jnp.asarray(self.share, w.dtype)
        q = share * w + (1 - share) / w.shape[0]
        drawn = q > 0
        log_q = jnp.log(jnp.where(drawn, q, 1.0))
        ancestor = self.resample(jax.lax.stop_gradient(jnp.where(drawn, log_q, -jnp.inf)), key)
        # A ratio of logarithms where there is a weight: double where, for the gradient.
        positive = w > 0
        ratio = jnp.where(positive, log_w, 0.0) - jnp.where(positive, log_q, 0.0)
        ratio = jnp.where(positive, ratio, -jnp.inf)[ancestor]
        _, log_sum, some = normalize(jax.lax.stop_gradient(ratio))
        return ancestor, jnp.where(some, ratio - log_sum, even(log_weights))


@record
class StopGradient:
    """The stop-gradient estimator (Ścibior & Wood 2021, "Differentiable particle filtering without
    modifying the forward pass"): a copy of j has the weight

        (1/P) · w_j/⊥(w_j)        ⊥ being `jax.lax.stop_gradient`

    that is 1/P, so values do not change; its derivative is (1/P) ∂ log w_j, and

        E Σ_i (1/P) f(a_i) ∂ log w_{a_i} = Σ_j f_j ∂w_j

    **Unbiased** for expectations, so that the gradient of the filter's estimate of the likelihood
    has the gradient of the likelihood for its mean, and that of its logarithm tends to the score
    with the number of particles (its bias is of order 1/P, as that of the logarithm itself). The
    price is variance, which grows with the length of the log: all terms of a lineage that dies out
    are lost.

    A caller must not normalize these weights again: their sum is 1, but its gradient is not 0.
    """

    resample: Resample = field(default=systematic, check=function_of("log_weights", "key"))
    """method that draws the indices; unbiased, as those of `jaxslam.resampling` are"""

    def __call__(
        self, log_weights: Float[Array, "P"], key: Array
    ) -> tuple[Int[Array, "P"], Float[Array, "P"]]:
        log_w, _, some = normalize(log_weights)
        ancestor = self.resample(jax.lax.stop_gradient(log_weights), key)
        chosen = jnp.where(some, log_w, 0.0)[ancestor]
        # Particles of weight zero are not drawn; the where keeps gradients of the others finite.
        chosen = jnp.where(jnp.isfinite(chosen), chosen, 0.0)
        return ancestor, even(log_weights) + (chosen - jax.lax.stop_gradient(chosen))
