"""Numbers that are not finite: which they are, and the dump of the update that made them."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sndjax import Experience, TrainState

from ..config.command_text import replay_command
from ..config.saved import SavedConfig, to_yaml
from ..config.schema import Config
from ..storage.array_trees import CheckpointError, write_tree
from ..storage.checkpoints import unwrap_keys
from ..system.versions import versions
from .experiment import Experiment, RunState
from .iterations import IterationResult
from .run_logger import RunLogger

PPO = ("policy_loss", "value_loss", "entropy", "kl", "ratio_clipped", "ppo_loss", "grad_norm")
LAST = ("module_loss", "module_grad_norm")


def computation_order(name: str) -> tuple[int, int]:
    """Return a sort key: the position of a metric in the computation of an update.

    The order is rewards, PPO, the intrinsic module, its loss and gradient, the state.
    """
    if name == "ext_reward" or name.startswith("int_"):
        return (0, name != "ext_reward")
    if name == "state":
        return (3, 0)
    if name in PPO:
        return (1, PPO.index(name))
    return (2, 1 + LAST.index(name) if name in LAST else 0)


def nonfinite_terms(
    seeds: list[int],
    reward: Any,
    valid: Any,
    metrics: dict[str, list[float]],
    frames: Any = None,
) -> list[str]:
    """Return a line for each term that is not finite, in the order of their computation.

    Args:
      seeds: the seed of each agent.
      reward: the rewards of the environments, [S, T, N].
      valid: which rows are valid, [S, T, N].
      metrics: the metrics of the update by name, one value for each seed.
      frames: the observations, [S, T + 1, N, ...]; they are read only if a metric is not finite.

    Returns:
      Lines "seed 0: kl is nan", sorted by seed and then by order of computation.
    """
    found = []
    for i, seed in enumerate(seeds):
        terms = {"ext_reward": float(np.asarray(reward[i])[np.asarray(valid[i])].sum())}
        terms |= {name: values[i] for name, values in metrics.items()}
        if not terms.pop("state_finite", True):
            terms["state"] = math.nan
        wrong = [name for name in terms if not math.isfinite(terms[name])]
        if wrong and frames is not None:
            found += [f"seed {seed}: {line}" for line in nonfinite_observation(frames[i], valid[i])]
        found += [
            f"seed {seed}: {name} is {terms[name]}" for name in sorted(wrong, key=computation_order)
        ]
    return found


def nonfinite_observation(frames: Any, valid: Any) -> list[str]:
    """Return a line for the first observation of a rollout that is not finite, if there is one.

    Args:
      frames: the observations of one seed, [T + 1, N, ...].
      valid: which rows are valid, [T, N].
    """
    if not np.issubdtype(frames.dtype, np.floating):
        return []
    frames, valid = np.asarray(frames), np.asarray(valid)
    no = np.zeros((1, valid.shape[1]), bool)
    read = np.concatenate([valid, no]) | np.concatenate([no, valid])  # as s_t, or as s_t+1
    values = frames.reshape(*read.shape, -1)
    wrong = np.argwhere(~np.isfinite(values) & read[..., None])
    if not wrong.size:
        return []
    step, env, component = (int(x) for x in wrong[0])
    place = f"environment {env}, step {step}, component {component}"
    return [f"the observation is {values[step, env, component]} ({place})"]


def write_dump(
    path: Path, config: Config, versions: dict[str, str], state: TrainState, batch: Experience
) -> None:
    """Write the dump that `experiments.replay` reads: the state before an update, and its batch.

    Args:
      path: the directory to create.
      config: the configuration of the run.
      versions: the versions of the packages, by name.
      state: the states of all seeds before the update.
      batch: the batch of the update.

    Raises:
      OSError: the dump cannot be written.
    """
    tree = jax.tree.map(np.asarray, {"state": unwrap_keys(state), "batch": batch})
    write_tree(path, tree, {"config": to_yaml(SavedConfig(config, versions))})


def keep_failed_update(
    logger: RunLogger,
    experiment: Experiment,
    result: IterationResult,
    recover: Callable[[], tuple[RunState, Experience]],
    save: Callable[[RunState], None],
) -> tuple[RunState | None, str]:
    """Save the state before an update that failed and a dump of the update.

    Args:
      logger: of the run.
      experiment: of the run.
      result: the results of the iteration of the update.
      recover: returns the state before the update and the batch of the update.
      save: saves a checkpoint.

    Returns:
      The state before the update, or None if it cannot be read, and the error message for the user.
    """
    config, placement, before = experiment.config, experiment.placement, None
    figures = (config.seeds, result.info.reward, result.info.valid, result.metrics)
    wrong = nonfinite_terms(*figures)
    dump = logger.path / f"wrong-{logger.done + 1}"
    trouble = ""
    try:
        before, batch = recover()
        if placement.hosts == 1:  # of several hosts, none can read the frames of all
            wrong = nonfinite_terms(*figures, batch.rollout.frames)
        save(before)
        logger.flush()
        state, rows = placement.to_host((before.train, batch))
        if placement.is_leader:
            write_dump(dump, config, versions(), state, rows)
    except (OSError, CheckpointError) as error:
        trouble = f"; the dump could not be written: {error}"
    more = f" (and {len(wrong) - 1} more)" if len(wrong) > 1 else ""
    what = f"iteration {logger.done + 1}, {wrong[0]}{more}"
    good = f"; the last good checkpoint is that of iteration {logger.done}"
    return before, what + (trouble or f"{good}; to see why: {replay_command(dump, config)}")
