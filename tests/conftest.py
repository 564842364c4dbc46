"""Shapes in signatures are checked at run time, and shapes never broadcast by accident."""

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
    """Programs compiled for one file are let go with it: a process can map only so many."""
    yield
    jax.clear_caches()


@pytest.fixture(scope="module")
def quick_compilation():
    """Programs that compile in a third of the time, for tests that look at other things.

    Native convolutions for ours (test_convolution.py holds both equal), normal weights for
    orthogonal ones (test_networks.py looks at those).
    """
    import flax.linen as nn

    from sndjax import convolution, networks

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(networks, "convolve", convolution.convolve_native)
        normal = lambda gain: nn.initializers.variance_scaling(gain**2, "fan_in", "normal")
        patch.setattr(nn.initializers, "orthogonal", normal)
        yield
