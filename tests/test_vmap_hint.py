import warnings

import jax
import jax.numpy as jnp
import pytest

from sndjax import vmap_hint
from sndjax.vmap_hint import FLAG, hint_under_vmap


@pytest.fixture
def affected(monkeypatch):
    monkeypatch.setattr(vmap_hint.jaxlib, "__version__", "0.10.2")
    monkeypatch.setattr(vmap_hint.os, "cpu_count", lambda: 2)
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    return monkeypatch


def test_hint_under_vmap_several_agents_on_two_cores_are_warned_of_once(affected):
    with pytest.warns(UserWarning, match=r"2 agents .* may never end. Set XLA_FLAGS=--xla_cpu"):
        got = jax.jit(jax.vmap(hint_under_vmap))(jnp.arange(2))
    assert got.tolist() == [0, 1]


@pytest.mark.parametrize("case", ["flag", "cores", "version", "one agent", "no vmap"])
def test_hint_under_vmap_where_it_does_not_apply_says_nothing(affected, case):
    if case == "flag":
        affected.setenv("XLA_FLAGS", f"--xla_other=1 {FLAG}")
    if case == "cores":
        affected.setattr(vmap_hint.os, "cpu_count", lambda: 64)
    if case == "version":
        affected.setattr(vmap_hint.jaxlib, "__version__", "0.11.0")
    agents = jnp.arange(1 if case == "one agent" else 2)
    function = hint_under_vmap if case == "no vmap" else jax.vmap(hint_under_vmap)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert jax.jit(function)(agents).tolist() == agents.tolist()
