"""Check the shapes in signatures at run time, and forbid broadcasting between ranks."""

from experiments.system.process import configure_xla

configure_xla()  # before jax starts: without it agents under vmap can wait for ever on two cores

import jax
import pytest
from jaxtyping import install_import_hook

# Before the first import of the library, so that its functions are wrapped.
install_import_hook("sndjax", "beartype.beartype")

# What is compiled here runs once or twice: most of the time would go into optimising it.
jax.config.update("jax_disable_most_optimizations", True)
jax.config.update("jax_numpy_rank_promotion", "raise")


@pytest.fixture(autouse=True, scope="module")
def forget_compilations():
    """Clear compiled programs after each test file: a process can map only a limited number."""
    yield
    jax.clear_caches()


@pytest.fixture(scope="module")
def quick_compilation():
    """Shorten compilation to a third of the time, for tests that do not test these parts.

    Native convolutions replace ours (test_convolution.py tests that both are equal), and normal
    initial weights replace orthogonal ones (test_networks.py tests those).
    """
    import flax.linen as nn

    from sndjax import convolution, networks

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(networks, "convolve", convolution.convolve_native)
        normal = lambda gain: nn.initializers.variance_scaling(gain**2, "fan_in", "normal")
        patch.setattr(nn.initializers, "orthogonal", normal)
        yield
