import jax
import jax.numpy as jnp

from experiments.training.flops import count_flops, estimate_seconds
from sndjax.convolution import Convolution, convolve, convolve_native


def test_count_flops_patches_and_native_convolution_are_equal():
    x, weights = jnp.ones((16, 12, 12, 3)), ((jnp.ones((3, 3, 3, 5)), jnp.ones(5)),)
    layers = (Convolution(5, stride=2),)
    by_hand = 2 * 16 * 6 * 6 * 5 * 3 * 3 * 3
    for lowering in (convolve, convolve_native):
        program = jax.make_jaxpr(lambda w: lowering(x, w, layers, "relu", (0,)))(weights)  # noqa: B023
        assert count_flops(program.jaxpr) == by_hand
    training = jax.make_jaxpr(
        jax.grad(lambda x, w: convolve(x, w, layers, "relu", (0,))[0].sum(), (0, 1))
    )(x, weights)
    assert count_flops(training.jaxpr) == 3 * by_hand  # forward 1, backward 2


def test_estimate_seconds_matrix_product_is_between_zero_and_one_second():
    program = jax.make_jaxpr(lambda a: a @ a)(jnp.ones((64, 64)))
    assert 0 < estimate_seconds(program.jaxpr) < 1
