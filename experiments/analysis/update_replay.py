"""The replay of an update that produced NaN or Inf, from the dump that its run wrote."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from sndjax import Experience, TrainState

from ..config.overrides import parse_overrides
from ..config.saved import apply_overrides, parse_saved
from ..config.schema import Config
from ..storage.array_trees import CheckpointError, read_manifest, read_tree
from ..storage.checkpoints import unwrapped_shapes
from ..system.errors import ConfigError
from ..training.experiment import Experiment, build_experiment
from ..training.nonfinite import nonfinite_terms
from ..training.rollouts import experience_spec


def dump_config(dump: Path, arguments: list[str]) -> Config:
    """Return the configuration of a dump; the arguments may only repeat its settings.

    Raises:
      ConfigError: the directory is not a dump, an argument differs from its configuration, or the
        configuration names code that the arguments do not repeat.
    """
    try:
        text = read_manifest(dump)["config"]
    except (CheckpointError, KeyError) as error:
        raise ConfigError(f"{dump} is no dump of a run: {error}") from None
    return apply_overrides(
        parse_saved(str(text), str(dump)).config, parse_overrides(arguments), "replay"
    )


def load_dump(dump: Path, config: Config) -> tuple[Experiment, TrainState, Experience]:
    """Return the experiment of a dump, the state and the batch of all seeds, leaves [S, ...].

    Raises:
      ConfigError: the dump is damaged.
    """
    experiment = build_experiment(config, probe=True)
    like = {
        "state": unwrapped_shapes(experiment.run_shapes().train),
        "batch": experience_spec(config, experiment.pool, experiment.agent.network),
    }
    try:
        tree, _ = read_tree(dump, like)
    except CheckpointError as error:
        raise ConfigError(f"{dump} is damaged: {error}") from None
    state, batch = jax.tree.map(jnp.asarray, (tree["state"], tree["batch"]))
    return experiment, state._replace(key=jax.random.wrap_key_data(state.key)), batch


def nonfinite_leaves(tree: Any) -> Iterator[str]:
    """Yield a line for every array of a pytree that contains NaN or Inf."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if np.issubdtype(leaf.dtype, np.inexact):
            count = int(np.sum(~np.isfinite(leaf)))
            if count:
                yield f"{jax.tree_util.keystr(path).lstrip('.')}: {count} of {leaf.size}"


def replay_update(experiment: Experiment, state: TrainState, batch: Experience) -> None:
    """Run the update again, and print which of its inputs and results are not finite.

    Args:
      experiment: the experiment of the dump.
      state: the state before the update, leaves [S, ...].
      batch: the batch of the update, leaves [S, ...].
    """
    inputs = {"state before": cast(Any, state)._replace(key=None), "batch": batch}
    for name, tree in inputs.items():
        for line in nonfinite_leaves(tree):
            print(f"{name}, not finite: {line}")
    step = jax.jit(experiment.make_train_step())
    print("updating ...", flush=True)
    metrics: dict[str, list[float]] = {
        name: value.tolist() for name, value in step(state, batch)[1].items()
    }
    found = nonfinite_terms(experiment.config.seeds, batch.reward, batch.rollout.valid, metrics)
    for line in found:
        print(f"after the update, {line}")
    if not found:
        print("after the update every figure is finite: it does not go wrong here")
        return
    if not any("nan" in line for line in found):
        return  # jax finds the operation that makes a NaN; for Inf it has false alarms
    print("looking for the operation, one after another; this can take minutes ...", flush=True)
    try:
        with jax.disable_jit(), jax.debug_nans(True):
            experiment.make_train_step()(state, batch)
        print("one by one, the operations give finite numbers")
    except FloatingPointError as error:
        print(f"the first comes out of: {str(error).splitlines()[0]}{error_place(error)}")


def error_place(error: BaseException) -> str:
    """Return the innermost line of an error's traceback outside installed packages."""
    found, trace = "", error.__traceback__
    while trace is not None:
        file = Path(trace.tb_frame.f_code.co_filename)
        if "site-packages" not in file.parts and file.suffix == ".py" and file != Path(__file__):
            found = f", in {file}, line {trace.tb_lineno}"
        trace = trace.tb_next
    return found
