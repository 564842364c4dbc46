"""How far a device's numbers are from those of a CPU in float32: losses, rewards, one iteration."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import sndjax
from sndjax.algorithms import NAMED

from ..system.jax_settings import PRECISIONS, at_precision
from .convolutions import policy_gradient

STEPS, ENVS, ACTIONS = 8, 8, 5
SHAPES = {"pixels": (64, 64, 3), "vector": (6,)}
SIZES = {"pixels": sndjax.SMALL, "vector": sndjax.VECTOR}
ONLY_PIXELS = ("snd_std", "sp")  # ST-DIM compares maps of an image


def example_batch(kind: str) -> sndjax.Experience:
    """Return a rollout of random numbers, the same on every machine.

    Args:
      kind: "pixels" or "vector".
    """
    draw, shape = np.random.default_rng(0), SHAPES[kind]
    frames: Any = (
        draw.integers(0, 256, (STEPS + 1, ENVS, *shape), np.uint8)
        if kind == "pixels"
        else draw.normal(size=(STEPS + 1, ENVS, *shape)).astype(np.float32)
    )
    done, valid, first = (np.zeros((STEPS, ENVS), bool) for _ in range(3))
    first[0] = valid[0] = True
    for t in range(STEPS):
        if t > 0:
            valid[t], first[t] = ~done[t - 1], ~valid[t - 1]  # a reset takes a row of its own
        done[t] = valid[t] & (draw.random(ENVS) < 0.2)
    rows: Any = lambda *more: draw.normal(size=(STEPS, ENVS, *more)).astype(np.float32)
    given: dict[str, Any] = {"action": draw.integers(0, ACTIONS, done.shape, np.int32)}
    given |= {"frames": frames, "first": first, "done": done, "valid": valid}
    own: dict[str, Any] = {"history": frames[:0], "truncated": np.zeros_like(done)}
    own |= {"reward": rows(), "log_prob": rows() - 2}
    own["value"] = draw.normal(size=(STEPS + 1, ENVS, 2)).astype(np.float32)
    return jax.tree.map(jnp.asarray, sndjax.Experience(sndjax.Rollout(**given), **own))


def loss_and_reward(name: str, kind: str) -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """Return a function of a module: its reward, its loss and the norm of the loss' gradient.

    Args:
      name: of the algorithm.
      kind: of its observations.

    Returns:
      The function and its arguments.
    """
    make: Any = NAMED[name]
    module, batch = make(ACTIONS, SIZES[kind]), example_batch(kind)
    params, state = module.init(jax.random.key(0), batch.rollout.frames[0])
    rows = jnp.arange(STEPS * ENVS)

    def compute(params: Any, state: Any, rollout: sndjax.Rollout) -> Any:
        key = jax.random.key(1)
        reward, _ = module.reward(params, state, rollout, key)
        minibatch = sndjax.gather_transitions(rollout, rows)
        loss = lambda params: module.loss(params, state, minibatch, rollout, key)
        if not jax.tree.leaves(params):
            return {"reward": reward}
        (total, _), gradient = jax.value_and_grad(loss, has_aux=True)(params)
        norm = jnp.sqrt(sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(gradient)))
        return {"reward": reward, "loss": total, "gradient norm": norm}

    return compute, (params, state, batch.rollout)


def one_iteration(kind: str) -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """Return `train_step` of SND-VIC with its arguments; its result is the metrics.

    Args:
      kind: of its observations.
    """
    size = SIZES[kind]
    module = sndjax.IntrinsicConfig(sndjax.snd_vic(ACTIONS, size), minibatch_size=16)
    network = sndjax.ActorCritic(size, ACTIONS)
    agent = sndjax.AgentSpec(network, sndjax.Hyperparameters(minibatch_size=16), module)
    batch = example_batch(kind)
    state = sndjax.init_train_state(agent, jax.random.key(0), batch.rollout.frames[0])
    step = sndjax.make_train_step(agent)
    shown = ("ppo_loss", "value_loss", "module_loss", "entropy", "grad_norm", "module_grad_norm")

    def compute(state: Any, batch: Any) -> Any:
        _, metrics, reward = step(state, batch)
        return {"reward": reward} | {name: metrics[name] for name in shown}

    return compute, (state, batch)


def convolutions() -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """Return the gradient of the policy's network on 512 Atari stacks, and its arguments."""
    loss, arguments = policy_gradient()

    def compute(params: Any, stacks: Any) -> Any:
        return jax.tree.map(jnp.ravel, jax.grad(loss)(params, stacks))

    return compute, arguments


def relative_difference(found: Any, wanted: Any) -> float:
    """Return the largest of max |found - wanted| / max |wanted| over the leaves of two trees.

    It is infinite where a number is not finite.
    """
    most = 0.0
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        a, b = np.asarray(one, np.float64), np.asarray(other, np.float64)
        if not (np.isfinite(a).all() and np.isfinite(b).all()):
            return float("inf")
        most = max(most, float(np.abs(a - b).max() / max(np.abs(b).max(), 1e-30)))
    return most


class Case(NamedTuple):
    """A computation that two devices are to agree on.

    Attributes:
      name: for the page.
      make: returns a function and its arguments.
      precisions: of products that it is tried at, beside the device's own.
    """

    name: str
    make: Callable[[], tuple[Callable[..., Any], tuple[Any, ...]]]
    precisions: tuple[str, ...] = ("float32",)


def cases() -> list[Case]:
    """Return every comparison, those that say most first."""
    every = tuple(PRECISIONS)
    found = [
        Case(f"one iteration of snd_vic, {kind}", partial(one_iteration, kind), every)
        for kind in SHAPES
    ]
    found.append(Case("gradient of the policy's network, 512 Atari stacks", convolutions, every))
    for name, make in NAMED.items():
        for kind in SHAPES if make is not None else ():
            if kind == "pixels" or name not in ONLY_PIXELS:
                found.append(Case(f"{name}, {kind}", partial(loss_and_reward, name, kind)))
    return found


def compare_numbers(toy: bool) -> Iterator[dict[str, Any]]:
    """Yield the relative differences of each case, for some precisions of products.

    Args:
      toy: only some cases, for a test.
    """
    for case in [cases()[i] for i in (1, 3, 10)] if toy else cases():
        try:
            yield {"case": case.name} | compare_case(case)
        except Exception as error:  # the other cases are worth knowing
            yield {"case": case.name, "error": repr(error).splitlines()[0]}


def compare_case(case: Case) -> dict[str, float]:
    """Return the relative differences of a case, by the precision of products.

    Args:
      case: the computation.
    """
    cpu, here = jax.devices("cpu")[0], jax.devices()[0]
    function, arguments = case.make()
    with jax.default_device(cpu):
        reference = jax.jit(at_precision("float32", function))
        wanted = reference(*jax.device_put(arguments, cpu))
    found = {}
    for precision in (None, *case.precisions):
        run = jax.jit(at_precision(precision, function))
        value = run(*jax.device_put(arguments, here))
        found[precision or "default"] = relative_difference(value, wanted)
    return found
