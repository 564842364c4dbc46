"""Compare what pools say about episodes with the environments themselves, stepped directly."""

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.config.compose import load_config
from experiments.config.envpool_tasks import envpool
from experiments.environments.pools import env_seeds, make_pool
from experiments.storage.episodes import EpisodeTracker
from experiments.system.errors import ConfigError, TaskError
from sndjax import Experience, Hyperparameters, Rollout
from sndjax.ppo import compute_advantages


def config(name, *more):
    return load_config([f"env={name}", "algo=rnd", *more]).env


def theirs(env, seed, num_envs, **more):
    seeds = env_seeds(seed, num_envs, 0)
    options = dict(env.options) | more
    return envpool.make(env.id, env_type="gymnasium", num_envs=num_envs, seed=seeds, **options)


def test_Pool_step_lost_life_opens_an_episode_whose_reset_row_is_not_valid():
    """envpool does not zero its count of steps after a lost life; `lives` tells what happened."""
    env = config("envpool", "env.id=Breakout-v5", "env.options.episodic_life=true")
    pool, own, rng = make_pool(env, [0], 8), theirs(env, 0, 8), np.random.default_rng(0)
    pool.reset()
    own.reset()
    tracker, wanted = EpisodeTracker([0], 8, False), []
    length, score = np.zeros(8, int), np.zeros(8)
    ended, lost, games = np.zeros(8, bool), 0, []
    for _ in range(400):
        action = rng.integers(0, 4, 8)
        step = pool.step(action[None])
        _, _, terminated, truncated, info = own.step(action.astype(np.int32))
        np.testing.assert_array_equal(step.valid[0], ~ended)
        over = (terminated | truncated) & (info["lives"] == 0)
        np.testing.assert_array_equal(step.done[0], terminated | truncated)
        np.testing.assert_array_equal(step.game_over[0], over)
        length, score = length + ~ended, score + np.where(ended, 0, info["reward"])
        for n in np.flatnonzero(over):
            wanted.append((length[n], score[n]))
            length[n] = score[n] = 0
        rows = [x[:, None] for x in (step.valid, step.game_over)]
        rewards = tuple(x[:, None] for x in (step.reward, step.score, step.reward))
        games += tracker.update(0, rows[0], rows[1], rewards, None)[0]
        lost += int((step.done & ~step.game_over).sum())
        ended = terminated | truncated
    assert lost > 50  # lives
    assert [(game.length, game.score) for game in games] == wanted  # each is a whole game
    assert len(wanted) >= 8


def test_Pool_step_game_over_at_the_step_limit_is_terminated():
    """Make the length of a game the limit: envpool then says truncated, although it is over."""
    base = ("env.id=Breakout-v5", "env.options.repeat_action_probability=0.0")

    def last_step(limit):
        pool = make_pool(config("envpool", *base, f"env.options.max_episode_steps={limit}"), [0], 1)
        pool.reset()
        rng = np.random.default_rng(0)
        for count in range(1, 3000):
            step = pool.step(rng.integers(0, 4, (1, 1)))
            if step.done[0, 0]:
                return count, bool(step.truncated[0, 0])
        raise AssertionError("the game does not end")

    length, truncated = last_step(3000)
    assert not truncated
    assert last_step(length) == (length, False)
    assert last_step(length - 1) == (length - 1, True)


class Stairs(gym.Env):
    """The goal is the third step; a limit of three steps ends the episode there too."""

    observation_space = gym.spaces.Box(0, 3, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, fails=""):
        self.fails = fails

    def reset(self, *, seed=None, options=None):
        self.at = 0
        return np.array([0], np.float32), {}

    def step(self, action):
        self.at += 1
        if self.fails == "system exit":
            raise SystemExit(7)
        if self.fails:
            raise {"disk": OSError, "number": FloatingPointError, "value": ValueError}[self.fails](
                "of the task"
            )
        return np.array([self.at], np.float32), 0.5, self.at == 3, self.at == 3, {}


gym.register("Stairs-v0", entry_point=Stairs)


def test_Pool_step_terminated_and_truncated_is_terminated_and_not_bootstrapped():
    """At the last step V = 5 and r = 1: the advantage is 1 - 5 = -4, nothing is bootstrapped."""
    pool = make_pool(config("gymnasium", "env.id=Stairs-v0", "env.reward=goal"), [0], 1)
    pool.reset()
    steps = [pool.step(np.zeros((1, 1), int)) for _ in range(3)]
    assert [s.truncated[0, 0] for s in steps] == [False] * 3
    assert [s.reward[0, 0] for s in steps] == [0, 0, 1]
    last = steps[-1]
    rollout = Rollout(
        frames=np.zeros((2, 1, 1)),
        action=np.zeros((1, 1), int),
        first=~last.valid,
        done=last.done,
        valid=last.valid,
    )
    batch = Experience(
        rollout=jax.tree.map(jnp.asarray, rollout),
        history=jnp.zeros((0, 1, 1)),
        reward=jnp.asarray(last.reward),
        truncated=jnp.asarray(last.truncated),
        log_prob=jnp.zeros((1, 1)),
        value=jnp.full((2, 1, 1), 5.0),
    )
    hyper = Hyperparameters(bootstrap_truncated=True, ext_weight=1)
    advantage, _ = compute_advantages(hyper, batch, jnp.zeros((1, 1)))
    np.testing.assert_allclose(advantage, -4)


def test_Pool_step_frozen_lake_goal_at_the_limit_is_terminated():
    """gymnasium sets both; the shortest way of a 2x2 lake is two steps."""
    gym.register(
        "Pond-v0",
        "gymnasium.envs.toy_text.frozen_lake:FrozenLakeEnv",
        kwargs={"desc": ["SF", "FG"], "is_slippery": False},
        max_episode_steps=2,
    )
    envs = gym.make_vec("Pond-v0", num_envs=1, vectorization_mode="sync")
    envs.reset()
    envs.step(np.array([2]))
    _, _, terminated, truncated, _ = envs.step(np.array([1]))
    assert terminated[0]
    assert truncated[0]
    pool = make_pool(config("gymnasium", "env.id=Pond-v0", "env.reward=goal"), [0], 1)
    pool.reset()
    pool.step(np.full((1, 1), 2))
    step = pool.step(np.full((1, 1), 1))
    assert (step.done[0, 0], step.truncated[0, 0], step.reward[0, 0]) == (True, False, 1)


@pytest.mark.parametrize(
    ("fails", "named"),
    [
        ("disk", "OSError: of the task"),
        ("number", "FloatingPointError: of the task"),
        ("value", "ValueError: of the task"),
        ("system exit", "SystemExit: 7"),
    ],
)
def test_Pool_step_failing_environment_raises_a_task_error_with_its_place(fails, named):
    env = config("gymnasium", "env.id=Stairs-v0", f"env.options.fails={fails!r}")
    pool = make_pool(env, [0], 2)
    pool.reset()
    with pytest.raises(TaskError) as raised:
        pool.step(np.zeros((1, 2), int))
    assert f"the environment Stairs-v0 failed: {named} ({__file__}, line " in str(raised.value)


def test_make_pool_environment_that_exits_is_refused():
    def exits():
        raise SystemExit(3)

    gym.register("Exits-v0", entry_point=exits)
    with pytest.raises(ConfigError, match="gymnasium cannot make Exits-v0: 3"):
        make_pool(config("gymnasium", "env.id=Exits-v0"), [0], 1)
