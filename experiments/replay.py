"""python -m experiments.replay <run>/wrong-<iteration>: an update that went wrong, once more.

Where the run's bonus or task is code, say algo.module=… or env.id=… again.

Reads the dump that a run leaves when a number is not finite: the configuration, the state
before the update and its batch. Says what of them was not finite already, runs the same update
again, and names the operation that the first such number comes out of.
"""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from experiments.config import parse as overrides
from experiments.options import Config, ConfigError
from experiments.process import before_jax
from experiments.run import refuse
from experiments.stored import apply, parse


def config_of(dump: Path, arguments: list[str]) -> Config:
    """The configuration that a dump was made with; the arguments may only repeat it.

    Raises:
      ConfigError: this is no dump, or it names code.
    """
    from experiments.checkpoint import Damaged, manifest_of

    try:
        text = manifest_of(dump)["config"]
    except (Damaged, KeyError) as error:
        raise ConfigError(f"{dump} is no dump of a run: {error}") from None
    return apply(parse(str(text), str(dump)).config, overrides(arguments), "replay")


def load(dump: Path, config: Config) -> tuple[Any, Any, Any]:
    """The agent, and from the dump the state of every seed and its batch, leaves [S, ...].

    Raises:
      ConfigError: the dump is damaged.
    """
    import jax
    import jax.numpy as jnp

    from experiments.agents import build, first_states
    from experiments.checkpoint import Damaged, raw_like, read
    from experiments.collect import shapes
    from experiments.environments import make_pool

    pool = make_pool(config.env, config.seeds, config.num_envs)
    agent = build(config, pool)
    example = jnp.zeros((config.num_envs, *pool.shape), pool.dtype)
    like = {
        "state": raw_like(jax.eval_shape(lambda: first_states(agent, config.seeds, example))),
        "batch": shapes(pool, config.env.stack, config.rollout_length, agent.network.value_heads),
    }
    try:
        tree, _ = read(dump, like)
    except Damaged as error:
        raise ConfigError(f"{dump} is damaged: {error}") from None
    state, batch = jax.tree.map(jnp.asarray, (tree["state"], tree["batch"]))
    return agent, state._replace(key=jax.random.wrap_key_data(state.key)), batch


def broken(tree: Any) -> Iterator[str]:
    """The arrays of a pytree that hold numbers that are not finite."""
    import jax
    import numpy as np

    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if np.issubdtype(leaf.dtype, np.inexact):
            count = int(np.sum(~np.isfinite(leaf)))
            if count:
                yield f"{jax.tree_util.keystr(path).lstrip('.')}: {count} of {leaf.size}"


def replay(agent: Any, config: Config, state: Any, batch: Any) -> None:
    """Print what goes wrong, from the inputs on."""
    import jax

    from experiments.agents import make_train_step
    from experiments.symptoms import not_finite

    inputs = {"state before": state._replace(key=None), "batch": batch}
    for name, tree in inputs.items():
        for line in broken(tree):
            print(f"{name}, not finite: {line}")
    step = jax.jit(make_train_step(agent, config))
    print("updating ...", flush=True)
    metrics: dict[str, list[float]] = {
        name: value.tolist() for name, value in step(state, batch)[1].items()
    }
    found = not_finite(config.seeds, batch.reward, batch.rollout.valid, metrics)
    for line in found:
        print(f"after the update, {line}")
    if not found:
        print("after the update every figure is finite: it does not go wrong here")
        return
    if not any("nan" in line for line in found):
        return  # jax finds the operation that makes a nan, and has false alarms about infinity
    print("looking for the operation, one after another; this can take minutes ...", flush=True)
    try:
        with jax.disable_jit(), jax.debug_nans(True):
            make_train_step(agent, config)(state, batch)
        print("one by one, the operations give finite numbers")
    except FloatingPointError as error:
        print(f"the first comes out of: {str(error).splitlines()[0]}{place_of(error)}")


def place_of(error: BaseException) -> str:
    """The innermost line of code outside jax and its like that an error came through."""
    found, trace = "", error.__traceback__
    while trace is not None:
        file = Path(trace.tb_frame.f_code.co_filename)
        if "site-packages" not in file.parts and file.suffix == ".py" and file != Path(__file__):
            found = f", in {file}, line {trace.tb_lineno}"
        trace = trace.tb_next
    return found


def main(arguments: list[str]) -> int:
    """The command."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(__doc__)
        return 0 if arguments else 2
    before_jax()
    try:
        dump = Path(arguments[0])
        config = config_of(dump, arguments[1:])
        agent, state, batch = load(dump, config)
        replay(agent, config, state, batch)
    except ConfigError as error:
        return refuse(error)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
