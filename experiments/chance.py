"""python -m experiments.chance env=CoinrunEasy keep=10: how often chance alone is rewarded.

Plays total_steps with an agent that draws actions uniformly, and says how many episodes had a
reward: where it is none, a bonus has something to do. keep=10 keeps an action for ten steps on
average (1, the default: each is drawn). Takes the options of `experiments.run` that make
environments, and seed.
"""

import sys
from dataclasses import dataclass

import numpy as np

from experiments.arguments import read
from experiments.config import load
from experiments.environments import make_pool
from experiments.options import Config, ConfigError, option
from experiments.progress import Bars
from experiments.run import refuse


@dataclass(frozen=True)
class Options:
    """What can be chosen."""

    keep: float = option(1.0, "steps that an action is kept, on average", low=1)


def kept(rng: np.random.Generator, last: np.ndarray, actions: int, new: float) -> np.ndarray:
    """The next actions, int64[N]: each the last one, or with probability `new` a new draw."""
    drawn = rng.integers(0, actions, last.shape)
    return np.where(rng.random(last.shape) < new, drawn, last)


def played(config: Config, keep: float) -> tuple[np.ndarray, np.ndarray, int | None]:
    """The returns float64[E] and lengths int64[E] of the episodes that ended, the first reward.

    The first reward is the number of steps that had been taken, or None where there was none.
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
    with Bars() as bars:
        while taken < config.total_steps:
            executed = kept(rng, action, pool.num_actions, env.random_action)
            step = pool.step(executed[None])
            taken += int(step.valid.sum())
            total += step.reward[0]
            length += step.valid[0]
            if first is None and (step.reward > 0).any():
                first = taken
            over = step.done[0]
            returns += total[over].tolist()
            lengths += length[over].tolist()
            total[over], length[over] = 0, 0
            action = kept(rng, action, pool.num_actions, 1 / keep)
            bars.to("steps", taken, config.total_steps)
    pool.close()
    return np.array(returns), np.array(lengths), first


def main(arguments: list[str]) -> int:
    """Print one line."""
    if not arguments or {"--help", "-h"} & set(arguments):
        print(str(__doc__).strip())
        return 0 if arguments else 2
    try:
        own = [argument for argument in arguments if argument.startswith("keep=")]
        keep = read(own, Options)[1].keep
        config = load(["algo=ppo", *(a for a in arguments if a not in own)])
        returns, lengths, first = played(config, keep)
    except ConfigError as error:
        return refuse(error)
    if not len(returns):
        return refuse(f"no episode ended in {config.total_steps:,} steps; take more total_steps")
    print(
        f"{config.env.name}, {config.total_steps:,} steps, keep={keep:g}: "
        f"{(returns > 0).sum()} of {len(returns):,} episodes rewarded, "
        + (f"the first by step {first:,}" if first else "no reward")
        + f"; mean length {lengths.mean():.0f}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
