"""Diagnostics: what to know before a run, and metrics that show that nothing is learned."""

import math
from collections import deque
from collections.abc import Iterator
from typing import Any

from sndjax import AgentSpec

from ..config.jax_suites import JAX_SUITES
from ..config.schema import Config
from ..environments.observations import Reader

WINDOW = 10  # iterations over which a metric is averaged before a warning


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


def announcements(config: Config, agent: AgentSpec, reader: Reader, done: int) -> Iterator[str]:
    """Yield what a user should know before the first iteration.

    Args:
      config: of the run.
      agent: what learns.
      reader: of the observations.
      done: iterations that the run has had before.
    """
    yield f"observations: {reader.description}"
    yield from (f"warning: {doubt}" for doubt in reader.doubts)
    has_scale = agent.intrinsic is None or agent.intrinsic.module.has_published_scale
    if not has_scale and config.algo.reward_scale == "none":
        yield (
            "the bonus has no published scale: unless its share of clipped rewards stays low, take "
            "algo.reward_scale=running_std"
        )
    if config.combine == "product":
        yield (
            "combine=product: the reward is 0 wherever the external reward is; on a task that is "
            "rewarded at its goal alone nothing explores until the goal is found by chance"
        )
    if 0 < done < config.iterations:
        kept = config.env.suite in JAX_SUITES
        how = "go on where they were" if kept else "begin new episodes"
        yield f"resuming from iteration {done}; environments {how}"
