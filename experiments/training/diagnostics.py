"""Diagnostics: values that are not finite, and metrics that show that nothing is learned."""

import math
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sndjax import AgentSpec, Experience, TrainState

from ..config.saved import SavedConfig, to_yaml
from ..config.schema import Config
from ..storage.array_trees import write_tree
from ..storage.checkpoints import unwrap_key

WINDOW = 10  # iterations over which a metric is averaged before a warning
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
    seeds: list[int], reward: Any, valid: Any, metrics: dict[str, list[float]]
) -> list[str]:
    """Return a line for each term that is not finite, in the order of their computation.

    Args:
      seeds: the seed of each agent.
      reward: the rewards of the environments, [S, T, N].
      valid: which rows are valid, [S, T, N].
      metrics: the metrics of the update by name, one value for each seed.

    Returns:
      Lines "seed 0: kl is nan", sorted by seed and then by order of computation.
    """
    found = []
    for i, seed in enumerate(seeds):
        terms = {"ext_reward": float(np.asarray(reward[i])[np.asarray(valid[i])].sum())}
        terms |= {name: values[i] for name, values in metrics.items()}
        if not terms.pop("state_finite", True):
            terms["state"] = math.nan
        found += [
            f"seed {seed}: {name} is {terms[name]}"
            for name in sorted(terms, key=computation_order)
            if not math.isfinite(terms[name])
        ]
    return found


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
    tree = jax.tree.map(np.asarray, {"state": unwrap_key(state), "batch": batch})
    write_tree(path, tree, {"config": to_yaml(SavedConfig(config, versions))})


class HealthMonitor:
    """A monitor of the recent metrics of a seed; each warning is given once."""

    def __init__(self, num_actions: int):
        entropy = math.log(num_actions)
        self.recent: dict[str, deque[float]] = {}
        self.warned: set[str] = set()
        # metric -> (a test whether its mean over the last iterations is bad, advice)
        self.signs = {
            "feature_spread": (
                lambda value: value < 1e-4,
                "the encoder has collapsed: all states have the same features, so the signal "
                "carries no information. The thesis regularises against it: snd_vic's variance "
                "term (eq. 5.7), snd_std's norm and spread terms (eq. 5.3-5.6)",
            ),
            "int_reward_clipped": (
                lambda value: value > 0.5,
                "more than half of the intrinsic rewards are cut off at 1 and no longer "
                "distinguish states. The thesis chooses eta per environment among 0.25, 0.5 and 1: "
                "take a smaller algo.eta, or algo.reward_scale=running_std",
            ),
            "entropy": (
                lambda value: value < 0.01 * entropy,
                "the policy is dead: it has almost stopped choosing (entropy below 1% of ln A). "
                "The thesis keeps it high with an entropy weight of 0.001 (Table 5.2): take a "
                "larger ppo.entropy_weight, or a smaller ppo.learning_rate",
            ),
            "skipped": (
                lambda value: value == 1,
                "every one of the last iterations was skipped: what makes its numbers go wrong "
                "stays. The thesis does not cover this; find the cause with on_nan=stop",
            ),
        }

    def update(self, line: dict[str, Any]) -> list[str]:
        """Add a line of metrics, and return the new warnings."""
        found = []
        for name, (bad, advice) in self.signs.items():
            value = line.get(name)
            if value is None or name in self.warned:
                continue
            recent = self.recent.setdefault(name, deque(maxlen=WINDOW))
            recent.append(value)
            mean = sum(recent) / len(recent)
            if len(recent) == WINDOW and bad(mean):
                self.warned.add(name)
                found.append(f"warning, seed {line['seed']}: {name} {mean:.2g}: {advice}")
        return found


def announcements(config: Config, agent: AgentSpec, done: int) -> Iterator[str]:
    """Yield what a user should know before the first iteration.

    Args:
      config: of the run.
      agent: what learns.
      done: iterations that the run has had before.
    """
    has_scale = agent.intrinsic is None or agent.intrinsic.module.has_published_scale
    if not has_scale and config.algo.reward_scale == "none":
        yield (
            "the bonus has no published scale: unless its share of clipped rewards stays low, take "
            "algo.reward_scale=running_std"
        )
    if 0 < done < config.iterations:
        yield f"resuming from iteration {done}; environments begin new episodes"
