"""The replacements for Atari in the scripts of other projects; see `sndjax external`.

torch and the packages of these projects are imported where they are used: nothing else needs them.
"""

from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np

from ...environments.pool import EnvStep, Pool
from ...system.display import ProgressBars

WRAPPERS = ("ClipRewardEnv", "EpisodicLifeEnv", "FireResetEnv", "MaxAndSkipEnv", "NoopResetEnv")


class EpisodeCountingEnv:
    """The environments of a script, with the returns of the episodes that ended."""

    def __init__(self, pool: Pool, bars: ProgressBars, total: int):
        """Start counting.

        Args:
          pool: the environments.
          bars: the progress display.
          total: the number of steps that the progress display shows as the whole.
        """
        self.pool, self.bars, self.total = pool, bars, total
        self.rows = 0
        self.ended: list[tuple[int, float]] = []  # rows so far, and the return
        self.running = np.zeros(pool.rows[1])

    def reset(self) -> np.ndarray:
        """Reset, and return the first frames, float32 [N, D]."""
        self.running[:] = 0
        return self.pool.reset()[0]

    def step(self, action: Any) -> EnvStep:
        """Step every environment; arrays are [N, ...].

        A reset takes a separate step, as in envpool and gymnasium; for the scripts it is a normal
        step, at most one in 201.
        """
        step = self.pool.step(np.asarray(action)[None])
        step = EnvStep(*(x if x is None else x[0] for x in step))  # type: ignore[arg-type]
        self.rows += len(step.done)
        self.running += step.reward
        self.ended += [(self.rows, value) for value in self.running[step.done].tolist()]
        self.running[step.done] = 0
        # The length of the warm-up is not known: show at least one more step to come.
        self.bars.update("steps", self.rows, max(self.total, self.rows + 1))
        return step

    def summary(self, seed: int, trained: int) -> dict[str, Any]:
        """Return the entry of summary.json for the last `trained` steps, without the warm-up."""
        warm_up = self.rows - trained
        returns = [value for rows, value in self.ended if rows > warm_up]
        mean = lambda x: float(np.mean(x)) if x else None
        return {
            "seed": seed,
            "steps": trained,
            "warm_up_steps": warm_up,
            "episodes": len(returns),
            "mean_ext_return": mean(returns),
            "last100_ext_return": mean(returns[-100:]),
        }


class NullWriter:
    """A SummaryWriter that writes nothing."""

    def __init__(self, *place: str):
        """Accept the arguments of a SummaryWriter."""

    def __getattr__(self, name: str) -> Any:
        return lambda *args, **named: None


def linear(wide: int, features: int, gain: float = 2**0.5) -> Any:
    """Make a linear layer with orthogonal weights and zero biases, as in both scripts.

    Args:
      wide: the number of inputs.
      features: the number of outputs.
      gain: the gain of the weights.
    """
    from torch import nn

    layer = nn.Linear(wide, features)
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


def cleanrl_networks(width: int, hidden: int = 64) -> dict[str, Any]:
    """Return CleanRL's policy and RND for frames [B, 4, 1, D], of which the last is read.

    The linear layers are in the same places as in the script, with the same gains; the three
    convolutions and the layer behind them are replaced by one layer (policy) or two (RND).
    """
    import torch
    from torch import nn

    newest = lambda x: x.reshape(len(x), -1, width)[:, -1]

    class Agent(nn.Module):
        def __init__(self, envs: Any):
            super().__init__()
            actions = int(envs.single_action_space.n)
            self.torso = nn.Sequential(
                linear(width, hidden), nn.ReLU(), linear(hidden, hidden), nn.ReLU()
            )
            self.aside = nn.Sequential(linear(hidden, hidden, 0.1), nn.ReLU())
            self.actor = nn.Sequential(
                linear(hidden, hidden, 0.01), nn.ReLU(), linear(hidden, actions, 0.01)
            )
            self.critics = nn.ModuleList(linear(hidden, 1, 0.01) for _ in range(2))

        def values(self, seen: Any) -> tuple[Any, ...]:
            return tuple(critic(self.aside(seen) + seen) for critic in self.critics)

        def get_value(self, x: Any) -> tuple[Any, ...]:
            return self.values(self.torso(newest(x)))

        def get_action_and_value(self, x: Any, action: Any = None) -> tuple[Any, ...]:
            seen = self.torso(newest(x))
            chosen = torch.distributions.Categorical(logits=self.actor(seen))
            action = chosen.sample() if action is None else action
            return action, chosen.log_prob(action), chosen.entropy(), *self.values(seen)

    class RNDModel(nn.Module):
        def __init__(self, *sizes: int):
            super().__init__()

            def body() -> list[Any]:
                leaky = nn.LeakyReLU
                layers = [linear(width, hidden), leaky(), linear(hidden, hidden), leaky()]
                return [nn.Flatten(), *layers, linear(hidden, hidden)]

            self.target = nn.Sequential(*body()).requires_grad_(False)
            more = [nn.ReLU(), linear(hidden, hidden), nn.ReLU(), linear(hidden, hidden)]
            self.predictor = nn.Sequential(*body(), *more)

        def forward(self, frame: Any) -> tuple[Any, Any]:
            return self.predictor(frame), self.target(frame)

    return {"Agent": Agent, "RNDModel": RNDModel}


def rlexplore_networks(width: int, hidden: int = 64) -> dict[str, Any]:
    """Return RLeXplore's policy for frames [B, D], with heads of one layer as in the script."""
    import torch
    from torch import nn

    class Agent(nn.Module):
        def __init__(self, envs: Any):
            super().__init__()
            actions = int(envs.single_action_space.n)
            self.torso = nn.Sequential(
                linear(width, hidden), nn.ReLU(), linear(hidden, hidden), nn.ReLU()
            )
            self.actor, self.critic = linear(hidden, actions, 0.01), linear(hidden, 1, 1.0)

        def get_value(self, x: Any) -> Any:
            return self.critic(self.torso(x))

        def get_action_and_value(self, x: Any, action: Any = None) -> tuple[Any, ...]:
            seen = self.torso(x)
            chosen = torch.distributions.Categorical(logits=self.actor(seen))
            action = chosen.sample() if action is None else action
            return action, chosen.log_prob(action), chosen.entropy(), self.critic(seen)

    return {"Agent": Agent}


def cleanrl_adapter(
    envs: EpisodeCountingEnv, settings: dict[str, Any], seed: int
) -> dict[str, Any]:
    """Return the replacement of Atari in CleanRL's script: old gym API, frames [N, 4, 1, D].

    Args:
      envs: the environments.
      settings: the settings of the script.
      seed: the seed of the script.
    """
    import gym

    (width,), size = envs.pool.shape, envs.pool.rows[1]
    stacked = lambda frame: np.repeat(frame[:, None, None], 4, axis=1)

    class Made:
        action_space = gym.spaces.Discrete(envs.pool.num_actions)
        observation_space = gym.spaces.Box(-1, 1, (4, 1, width))

        def __init__(self, *task: str, **options: Any):
            """Ignore the requested Atari task."""

        def reset(self) -> np.ndarray:
            return stacked(envs.reset())

        def step(self, action: Any) -> tuple[Any, ...]:
            step = envs.step(action)
            info = {"reward": step.reward, "terminated": step.done, "lives": np.zeros(size)}
            return stacked(step.frame), step.reward, step.done, info

        def close(self) -> None:
            """Do nothing: the pool is closed by its owner."""

    return {"envpool": SimpleNamespace(make=Made)} | cleanrl_networks(width)


def rlexplore_adapter(
    envs: EpisodeCountingEnv, settings: dict[str, Any], seed: int
) -> dict[str, Any]:
    """Return the replacement of Atari in RLeXplore's script: a gymnasium vector environment.

    Args:
      envs: the environments.
      settings: the settings of the script.
      seed: the seed of the script.
    """
    import gymnasium
    from rllte.xplore.reward import RND

    (width,), size = envs.pool.shape, envs.pool.rows[1]

    class Made(gymnasium.vector.VectorEnv):
        num_envs = size
        single_action_space = gymnasium.spaces.Discrete(envs.pool.num_actions, seed=seed)
        single_observation_space = gymnasium.spaces.Box(-1, 1, (width,))

        def __init__(self, makers: list[Any]):
            """Ignore the functions that make Atari."""

        def reset(self, **options: Any) -> tuple[np.ndarray, dict[str, Any]]:
            return envs.reset(), {}

        def step(self, action: Any) -> tuple[Any, ...]:
            step = envs.step(action)
            return step.frame, step.reward, step.done & ~step.truncated, step.truncated, {}

    gym = SimpleNamespace(spaces=gymnasium.spaces, vector=SimpleNamespace(SyncVectorEnv=Made))
    own = {k.removeprefix("rnd."): v for k, v in settings.items() if k.startswith("rnd.")}
    ours = {"gym": gym, "make_env": lambda *args: None, "RE3": partial(RND, **own)}
    return ours | dict.fromkeys(WRAPPERS) | rlexplore_networks(width)
