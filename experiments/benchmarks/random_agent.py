"""The rewards of an agent that draws its actions uniformly."""

import numpy as np

from ..config.schema import Config
from ..environments.pools import make_pool
from ..system.display import ProgressBars
from ..system.errors import ConfigError


def repeat_actions(
    rng: np.random.Generator, last: np.ndarray, actions: int, new: float
) -> np.ndarray:
    """Return the next actions, int64[N]: the last actions or, with probability `new`, draws.

    Args:
      rng: the random generator.
      last: the last actions.
      actions: A, the number of actions.
      new: the probability of a new draw.
    """
    drawn = rng.integers(0, actions, last.shape)
    return np.where(rng.random(last.shape) < new, drawn, last)


def play_random(config: Config, keep: float) -> tuple[np.ndarray, np.ndarray, int | None]:
    """Play `total_steps` steps with random actions.

    Returns:
      The returns float64[E] and lengths int64[E] of the episodes that ended, and the number of
      steps before the first reward, or None.
    """
    env, size = config.env, config.num_envs
    pool = make_pool(env, [config.seed], size)
    rng = np.random.default_rng(config.seed)
    pool.reset()
    action = rng.integers(0, pool.num_actions, size)
    total, length = np.zeros(size), np.zeros(size, int)
    returns: list[float] = []
    lengths: list[int] = []
    first, taken = None, 0
    with ProgressBars() as bars:
        while taken < config.total_steps:
            executed = repeat_actions(rng, action, pool.num_actions, env.random_action)
            step = pool.step(executed[None])
            taken += int(step.valid.sum())
            total += step.reward[0]
            length += step.valid[0]
            if first is None and (step.reward > 0).any():
                first = taken
            over = step.game_over[0]
            returns += total[over].tolist()
            lengths += length[over].tolist()
            total[over], length[over] = 0, 0
            action = repeat_actions(rng, action, pool.num_actions, 1 / keep)
            bars.update("steps", taken, config.total_steps)
    pool.close()
    return np.array(returns), np.array(lengths), first


def print_random_agent(config: Config, keep: float) -> None:
    """Play `total_steps` steps at random, and print how many episodes were rewarded.

    Raises:
      ConfigError: no episode ended.
    """
    returns, lengths, first = play_random(config, keep)
    if not len(returns):
        seen = f"the first reward by step {first:,}" if first else "no reward"
        raise ConfigError(
            f"no episode ended in {config.total_steps:,} steps ({seen}), and episodes are what is "
            "counted; take more total_steps, or a task whose episodes end"
        )
    print(
        f"{config.env.name}, {config.total_steps:,} steps, keep={keep:g}: "
        f"{(returns > 0).sum()} of {len(returns):,} episodes rewarded, "
        + (f"the first by step {first:,}" if first else "no reward")
        + f"; mean length {lengths.mean():.0f}"
    )
