"""What stands in for Atari in other people's scripts: see `experiments.peers`.

torch and their own packages are imported where they are used: nothing else needs them.
"""

from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np

from experiments.environments import Pool, Step
from experiments.progress import Bars

WRAPPERS = ("ClipRewardEnv", "EpisodicLifeEnv", "FireResetEnv", "MaxAndSkipEnv", "NoopResetEnv")


class Counted:
    """The environments of a script, and the returns of the episodes that it saw."""

    def __init__(self, pool: Pool, bars: Bars, total: int):
        """Nothing was stepped yet; `total` steps are expected."""
        self.pool, self.bars, self.total = pool, bars, total
        self.rows = 0
        self.returns: list[float] = []
        self.running = np.zeros(pool.rows[1])

    def reset(self) -> np.ndarray:
        """The first frames, float32 [N, D]."""
        self.running[:] = 0
        return self.pool.reset()[0]

    def step(self, action: Any) -> Step:
        """One step of every environment, arrays [N, ...]; a reset is a step, as in their pools."""
        step = self.pool.step(np.asarray(action)[None])
        step = Step(*(x if x is None else x[0] for x in step))  # type: ignore[arg-type]
        self.rows += len(step.done)
        self.running += step.reward
        self.returns += self.running[step.done].tolist()
        self.running[step.done] = 0
        self.bars.to("steps", self.rows, max(self.total, self.rows + 1))  # theirs begin at random
        return step

    def summary(self, seed: int, seconds: float) -> dict[str, Any]:
        """What summary.json says of a seed."""
        returns = self.returns
        mean = lambda x: float(np.mean(x)) if x else None
        return {
            "seed": seed,
            "steps": self.rows,
            "episodes": len(returns),
            "mean_ext_return": mean(returns),
            "last100_ext_return": mean(returns[-100:]),
            "wall_seconds": round(seconds, 1),
        }


class Nowhere:
    """A log that is not kept."""

    def __init__(self, *place: str):
        """Takes what a SummaryWriter takes."""

    def __getattr__(self, name: str) -> Any:
        return lambda *args, **named: None


def networks(width: int, heads: int, shape: str) -> dict[str, Any]:
    """Policy, and RND's two networks, for vectors, under the names that the scripts call them by.

    Hidden layers stand where the scripts' own stand, 64 wide for 256 to 512.

    Args:
      width: D, of a frame.
      heads: value heads: two in CleanRL's script, one in RLeXplore's.
      shape: how frames are cut from what the script holds, "row" [B, 4, 1, D] or "flat" [B, D].
    """
    import torch
    from torch import nn

    cut = {"row": lambda x: x.reshape(len(x), -1, width)[:, -1], "flat": lambda x: x}[shape]

    def linear(wide: int, features: int, gain: float = 2**0.5) -> nn.Linear:
        layer = nn.Linear(wide, features)
        nn.init.orthogonal_(layer.weight, gain)
        nn.init.zeros_(layer.bias)
        return layer

    def perceptron(*layers: Any) -> nn.Sequential:
        return nn.Sequential(*(x for layer in layers for x in (layer, nn.ReLU())))

    class Agent(nn.Module):
        """A torso of two layers, one more before the actor, one added before the critics."""

        def __init__(self, envs: Any):
            super().__init__()
            self.torso = perceptron(linear(width, 64), linear(64, 64))
            self.actor = nn.Sequential(
                perceptron(linear(64, 64, 0.01)), linear(64, int(envs.single_action_space.n), 0.01)
            )
            self.aside = perceptron(linear(64, 64, 0.1))
            self.critics = nn.ModuleList(linear(64, 1, 0.01) for _ in range(heads))

        def both(self, x: Any) -> tuple[Any, list[Any]]:
            hidden = self.torso(cut(x))
            valued = self.aside(hidden) + hidden
            return hidden, [critic(valued) for critic in self.critics]

        def get_value(self, x: Any) -> Any:
            _, values = self.both(x)
            return values if heads > 1 else values[0]

        def get_action_and_value(self, x: Any, action: Any = None) -> tuple[Any, ...]:
            hidden, values = self.both(x)
            chosen = torch.distributions.Categorical(logits=self.actor(hidden))
            action = chosen.sample() if action is None else action
            return action, chosen.log_prob(action), chosen.entropy(), *values

    class RNDModel(nn.Module):
        """The target is three layers, the predictor has two more."""

        def __init__(self, *sizes: int):
            super().__init__()
            body = lambda: perceptron(linear(width, 64), linear(64, 64))
            self.target = nn.Sequential(body(), linear(64, 64)).requires_grad_(False)
            more = perceptron(linear(64, 64), linear(64, 64))
            self.predictor = nn.Sequential(body(), more, linear(64, 64))
            self.target, self.predictor = (
                nn.Sequential(nn.Flatten(), net) for net in (self.target, self.predictor)
            )

        def forward(self, frame: Any) -> tuple[Any, Any]:
            return self.predictor(frame), self.target(frame)

    return {"Agent": Agent, "RNDModel": RNDModel}


def for_cleanrl(envs: Counted, settings: dict[str, Any]) -> dict[str, Any]:
    """What CleanRL's script gets instead of Atari: old gym's four values, frames [N, 4, 1, D]."""
    import gym

    (width,), size = envs.pool.shape, envs.pool.rows[1]
    stacked = lambda frame: np.repeat(frame[:, None, None], 4, axis=1)

    class Made:
        action_space = gym.spaces.Discrete(envs.pool.num_actions)
        observation_space = gym.spaces.Box(-1, 1, (4, 1, width))

        def reset(self) -> np.ndarray:
            return stacked(envs.reset())

        def step(self, action: Any) -> tuple[Any, ...]:
            step = envs.step(action)
            info = {"reward": step.score, "terminated": step.done, "lives": np.zeros(size)}
            return stacked(step.frame), step.reward, step.done, info

        def close(self) -> None:
            envs.pool.close()

    made = SimpleNamespace(make=lambda *args, **options: Made())
    return {"envpool": made} | networks(width, 2, "row")


def for_rlexplore(envs: Counted, settings: dict[str, Any]) -> dict[str, Any]:
    """What RLeXplore's script gets instead of Atari: a vector environment of gymnasium's."""
    import gymnasium
    from rllte.xplore.reward import RND

    (width,), size = envs.pool.shape, envs.pool.rows[1]

    class Made(gymnasium.vector.VectorEnv):
        num_envs = size
        single_action_space = gymnasium.spaces.Discrete(envs.pool.num_actions, seed=0)
        single_observation_space = gymnasium.spaces.Box(-1, 1, (width,))

        def __init__(self, makers: list[Any]):
            """The makers make Atari."""

        def reset(self, **options: Any) -> tuple[np.ndarray, dict[str, Any]]:
            return envs.reset(), {}

        def step(self, action: Any) -> tuple[Any, ...]:
            step = envs.step(action)
            return step.frame, step.reward, step.done & ~step.truncated, step.truncated, {}

        def close(self, **options: Any) -> None:
            envs.pool.close()

    gym = SimpleNamespace(
        spaces=gymnasium.spaces, vector=SimpleNamespace(SyncVectorEnv=Made), Wrapper=object
    )
    own = {k.removeprefix("rnd."): v for k, v in settings.items() if k.startswith("rnd.")}
    ours = {"gym": gym, "make_env": lambda *args: None, "RE3": partial(RND, **own)}
    return ours | dict.fromkeys(WRAPPERS) | networks(width, 1, "flat")
