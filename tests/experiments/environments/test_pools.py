"""Compare the pools with envpool and Gymnasium, on real environments."""

import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.config.compose import load_config
from experiments.config.envpool_tasks import envpool, family_of
from experiments.config.schema import EnvConfig
from experiments.environments.pools import env_seeds, gym, make_pool
from experiments.system.errors import ConfigError
from sndjax.rollout import push_frame


def config(name, *more):
    return load_config([f"env={name}", "algo=rnd", *more]).env


def test_push_frame_single_frames_equal_envpool_stacks_across_resets():
    env = config("Venture", "env.options.max_episode_steps=13")
    pool = make_pool(env, [3], 4)
    theirs = envpool.make(
        env.id,
        env_type="gymnasium",
        num_envs=4,
        seed=env_seeds(3, 4, 0),
        **(env.options | {"stack_num": 4}),
    )
    rng = np.random.default_rng(0)
    frame, (stack, _) = pool.reset()[0], theirs.reset()
    window = np.zeros((4, *frame.shape), np.uint8)
    first, resets = np.ones(4, bool), 0
    for _ in range(60):
        window = np.asarray(push_frame(*map(jnp.asarray, (window, frame, first)), repeat=True))
        np.testing.assert_array_equal(window[..., 0].swapaxes(0, 1), stack)
        action = rng.integers(0, 18, 4)
        step = pool.step(action[None])
        stack, *_ = theirs.step(action.astype(np.int32))
        frame, first = step.frame[0], ~step.valid[0]
        resets += int(first.sum())
    assert resets >= 12


def test_push_frame_first_procgen_stack_begins_with_zeros():
    env = config("Climber")
    assert (env.stack, env.repeat_first) == (2, False)
    pool = make_pool(env, [0], 2)
    frame = pool.reset()[0]
    assert frame.shape == (2, 64, 64, 3)
    old = jnp.full((2, *frame.shape), 9, jnp.uint8)
    window = np.asarray(push_frame(old, jnp.asarray(frame), jnp.ones(2, bool), False))
    assert not window[0].any()
    np.testing.assert_array_equal(window[1], frame)


def test_make_pool_coinrun_easy_is_level_9_in_every_episode():
    pool = make_pool(config("CoinrunEasy"), [0, 1], 16)
    first = pool.reset().copy()

    def own(level):
        made = envpool.make(
            "CoinrunEasy-v0", env_type="gymnasium", num_envs=1, num_levels=1, start_level=level
        )
        return np.asarray(made.reset()[0])[0].transpose(1, 2, 0)

    assert (first == own(9)).all()
    assert not (own(0) == own(9)).all()
    rng, again = np.random.default_rng(0), 0
    for _ in range(600):
        step = pool.step(rng.integers(0, 15, (2, 16)))
        began = step.frame[~step.valid]
        assert (began == first[0, 0]).all()
        again += len(began)
    assert again >= 16


def test_Pool_step_reset_rows_follow_done_rows_without_reward():
    pool = make_pool(config("MountainCar"), [0, 1], 5)
    pool.reset()
    rng, was_done, ends = np.random.default_rng(0), np.zeros((2, 5), bool), 0
    for _ in range(450):
        step = pool.step(rng.integers(0, 3, (2, 5)))
        np.testing.assert_array_equal(step.valid, ~was_done)
        assert not step.reward[~step.valid].any()
        assert not step.done[~step.valid].any()
        was_done = step.done
        ends += int(step.done.sum())
        assert step.frame.shape == (2, 5, 2)
        assert np.abs(step.frame).max() <= 1
    assert ends == 20  # two limits of 200 steps, each followed by a reset row


def test_make_pool_mountain_car_rewards_only_the_goal():
    pool = make_pool(config("MountainCar"), [0], 1)
    frame = pool.reset()
    goals = 0
    for _ in range(1000):  # accelerating in the direction of the velocity reaches the goal
        step = pool.step(np.where(frame[..., 1] >= 0, 2, 0))
        frame = step.frame
        if step.reward[0, 0]:
            goals += 1
            assert step.done[0, 0]
            assert not step.truncated[0, 0]
            assert frame[0, 0, 0] > 0.8  # position 0.5 of [-1.2, 0.6], scaled
        assert step.score[0, 0] == (-1 if step.valid[0, 0] else 0)
    assert goals >= 4


def test_make_pool_atari_reward_is_the_sign_and_rooms_come_from_ram():
    pool = make_pool(config("MontezumaRevenge"), [0], 2)
    assert pool.num_actions == 18
    pool.reset()
    step = pool.step(np.zeros((1, 2)))
    assert step.room.tolist() == [[1, 1]]  # the first room is number 1
    pong = make_pool(config("envpool", "env.id=Pong-v5"), [0], 8)
    pong.reset()
    rewards, scores = [], []
    for _ in range(120):
        step = pong.step(np.zeros((1, 8)))
        rewards.append(step.reward)
        scores.append(step.score)
    assert np.min(scores) == -1  # a player that does not move loses points
    np.testing.assert_array_equal(np.maximum(0, np.sign(scores)), rewards)


def test_env_seeds_other_seed_or_start_gives_a_separate_stream():
    streams = [env_seeds(seed, 8, start) for seed in (0, 1) for start in (0, 50)]
    assert len({s for stream in streams for s in stream}) == 32
    assert env_seeds(0, 8, 0) == env_seeds(0, 16, 0)[:8]
    frames = [make_pool(config("MountainCar"), [seed], 3).reset()[0] for seed in (0, 0, 1)]
    np.testing.assert_array_equal(frames[0], frames[1])
    assert np.all(frames[0][:, 0] != frames[2][:, 0])


def test_make_pool_one_seed_equals_the_same_seed_among_others():
    alone, together = (make_pool(config("Venture"), seeds, 2) for seeds in ([7], [6, 7]))
    frames = [alone.reset()[0], together.reset()[1]]
    for _ in range(30):
        np.testing.assert_array_equal(*frames)
        frames = [
            alone.step(np.full((1, 2), 2)).frame[0],
            together.step(np.full((2, 2), 2)).frame[1],
        ]


@pytest.mark.parametrize(
    ("task", "size", "unbounded"),
    [
        ("CartPole-v1", 4, (1, 3)),
        ("FrozenLake-v1", 16, ()),
        ("Catch-v0", 50, ()),
        ("LunarLander-v2", 8, tuple(range(8))),
    ],
)
def test_make_pool_other_tasks_give_vectors(task, size, unbounded):
    pool = make_pool(config("envpool", f"env.id={task}"), [0], 3)
    assert pool.shape == (size,)
    assert tuple(np.nonzero(pool.unbounded)[0]) == unbounded
    frame = pool.reset()
    assert frame.dtype == np.float32
    assert frame.shape == (1, 3, size)
    assert np.all(np.isfinite(pool.step(np.zeros((1, 3))).frame))


def test_family_of_unsupported_task_is_refused_by_name():
    assert family_of("Pong-v5") == "atari"
    assert family_of("JumperExploration-v0") == "procgen"
    assert family_of("CartPole-v1") == "plain"
    with pytest.raises(ConfigError, match="did you mean Pong-v5"):
        family_of("Pong-v4")
    with pytest.raises(ConfigError, match=r"Pendulum-v1 has Box actions of shape \(1,\)"):
        family_of("Pendulum-v1")
    with pytest.raises(ConfigError, match="cannot make Pong-v5"):
        make_pool(EnvConfig(name="x", id="Pong-v5", options={"no_such_option": 1}), [0], 1)


PLAIN_SYSTEM = """
import ctypes

def without_glib(path, *_, real=ctypes.CDLL, **more):
    if "libQt5Core" in str(path):
        raise OSError("libgthread-2.0.so.0: cannot open shared object file")
    return real(path, *_, **more)

ctypes.CDLL = without_glib
from experiments.config.envpool_tasks import family_of

print(family_of("Venture-v5"))
family_of("JumperExploration-v0")
"""


def test_family_of_without_qt_refuses_only_procgen():
    done = subprocess.run([sys.executable, "-c", PLAIN_SYSTEM], capture_output=True, text=True)
    assert done.stdout == "atari\n"
    refusal = done.stderr.splitlines()[-1]
    assert "envpool cannot make JumperExploration-v0: libgthread-2.0.so.0" in refusal
    assert "libglib2.0-0" in refusal


class Corridor(gym.Env):
    """Environment of a user: walk right to the end; `image` selects pixel observations."""

    def __init__(self, image=False, actions=None):
        self.image = image
        self.action_space = actions or gym.spaces.Discrete(2, start=1)
        box = gym.spaces.Box
        self.observation_space = (
            box(0, 255, (40, 48, 3), np.uint8) if image else box(0, 5, (1,), np.float32)
        )

    def look(self):
        if not self.image:
            return np.array([self.at], np.float32)
        return np.full((40, 48, 3), 10 * self.at, np.uint8)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at = 0
        return self.look(), {}

    def step(self, action):
        assert action in (1, 2)
        self.at += int(action == 2)
        return self.look(), float(self.at == 5), self.at == 5, False, {}


gym.register("Corridor-v0", entry_point=Corridor, max_episode_steps=8)


@pytest.mark.parametrize("image", [False, True])
def test_make_pool_user_environment_of_gymnasium_is_stepped(image):
    """Compare the pool with a plain loop, across episode ends and resets."""
    env = config("gymnasium", "env.id=Corridor-v0", f"env.options.image={image}")
    pool = make_pool(env, [0, 1], 3)
    assert pool.num_actions == 2
    assert pool.shape == ((40, 48, 3) if image else (1,))
    frame, rng = pool.reset(), np.random.default_rng(0)
    at, age = np.zeros((2, 3)), np.zeros((2, 3))
    ended = np.zeros((2, 3), bool)
    look = lambda: frame[..., 0, 0, 0] / 10 if image else (frame[..., 0] + 1) * 2.5
    for _ in range(60):
        np.testing.assert_allclose(look(), at)
        action = rng.integers(0, 2, (2, 3))
        step = pool.step(action)
        frame = step.frame
        at, age = np.where(ended, 0, at + action), np.where(ended, 0, age + 1)
        np.testing.assert_array_equal(step.valid, ~ended)
        np.testing.assert_array_equal(step.reward, (at == 5) & ~ended)
        limit = (age == 8) & (at < 5)
        np.testing.assert_array_equal(step.truncated, limit & ~ended)  # the goal wins
        ended = ((at == 5) | limit) & ~ended
        np.testing.assert_array_equal(step.done, ended)
    assert step.room is None
    pool.close()


def test_make_pool_gymnasium_task_repeats_by_seed_and_marks_reset_rows():
    pool = make_pool(config("gymnasium", "env.id=CartPole-v1"), [0], 3)
    frames = [make_pool(config("gymnasium", "env.id=CartPole-v1"), [s], 3).reset() for s in (0, 1)]
    np.testing.assert_array_equal(pool.reset(), frames[0])
    assert np.all(frames[0] != frames[1])
    ended = np.zeros((1, 3), bool)
    for _ in range(40):
        step = pool.step(np.zeros((1, 3), int))
        np.testing.assert_array_equal(step.valid, ~ended)
        ended = step.done
    assert step.frame.shape == (1, 3, 4)


def test_make_pool_unsupported_gymnasium_task_is_refused_by_name():
    with pytest.raises(ConfigError, match="observations of Tuple cannot be read"):
        make_pool(config("gymnasium", "env.id=Blackjack-v1"), [0], 2)
    with pytest.raises(ConfigError, match="did you mean CartPole-v1"):
        make_pool(config("gymnasium", "env.id=CartPol-v1"), [0], 2)
    with pytest.raises(ConfigError, match="Box actions"):
        make_pool(config("gymnasium", "env.id=Pendulum-v1"), [0], 2)
    with pytest.raises(ConfigError, match="gymnasium cannot make CartPole-v1"):
        make_pool(config("gymnasium", "env.id=CartPole-v1", "env.options.wrong=1"), [0], 2)
    with pytest.raises(ConfigError, match="gymnasium cannot make no_such_package:X-v0"):
        make_pool(config("gymnasium", "env.id=no_such_package:X-v0"), [0], 2)


FARAMA = "minigrid:MiniGrid-MultiRoom-N2-S4-v0"


def minigrid(*more):
    return load_config(["env=MiniGrid", "algo=rnd", *more]).env


def test_make_pool_minigrid_view_is_one_hot_with_direction():
    from minigrid.wrappers import OneHotPartialObsWrapper

    env = minigrid("env.id=minigrid:MiniGrid-KeyCorridorS3R3-v0")
    pool = make_pool(env, [0], 3)
    frame = pool.reset()[0]
    theirs = [OneHotPartialObsWrapper(gym.make(env.id)) for _ in range(3)]
    seeds = env_seeds(0, 3, 0)
    looks = [one.reset(seed=seed)[0] for one, seed in zip(theirs, seeds, strict=True)]
    rng = np.random.default_rng(0)
    for _ in range(60):
        for own, look in zip(frame, looks, strict=True):
            cells, direction = own[:-4].reshape(7, 7, 21), own[-4:]
            np.testing.assert_array_equal(cells[..., :20], look["image"])
            assert not cells[..., 20].any()  # the wrapper has only the states of doors
            assert direction[look["direction"]] == direction.sum() == 1
        action = rng.integers(0, 7, 3)
        frame = pool.step(action[None]).frame[0]
        looks = [one.step(a)[0] for one, a in zip(theirs, action, strict=True)]


def test_make_pool_minigrid_death_is_not_rewarded():
    pool = make_pool(minigrid("env.id=MiniGrid-LavaCrossingS9N1-v0"), [0], 64)
    pool.reset()
    rng, deaths = np.random.default_rng(0), 0
    for _ in range(200):
        step = pool.step(rng.integers(0, 3, (1, 64)))
        died = step.done & ~step.truncated & (step.score <= 0)
        assert not step.reward[died].any()
        deaths += died.sum()
    assert deaths > 10


def test_make_pool_envpool_minigrid_view_has_the_same_layout():
    pool = make_pool(minigrid("env.id=MiniGrid-DoorKey-8x8-v0"), [0, 1], 4)
    frames = pool.reset()
    assert frames.shape == (2, 4, 7 * 7 * 21 + 4)
    cells = frames[..., :-4].reshape(-1, 7, 7, 21)
    for part in (cells[..., :11], cells[..., 11:17], cells[..., 17:], frames[..., -4:]):
        np.testing.assert_array_equal(part.sum(-1), 1)
    assert pool.num_actions == 7
    assert pool.step(np.zeros((2, 4), int)).frame.shape == frames.shape


def solved(envs, count, steps, **reset):
    """Return the share of levels without a time limit that a random walk solves."""
    rng = np.random.default_rng(0)
    envs.reset(**reset)
    through = np.zeros(count, bool)
    for _ in range(steps):
        _, _, terminated, _, _ = envs.step(rng.choice([0, 1, 2, 2, 2, 5], count).astype(np.int32))
        through |= terminated
    return through.mean()


def test_load_config_refused_minigrid_levels_are_broken_and_replacements_are_not():
    task = FARAMA.removeprefix("minigrid:")
    with pytest.raises(ConfigError, match=f"env=MiniGrid env.id={FARAMA}"):
        minigrid(f"env.id={task}")
    assert minigrid(f"env.id={FARAMA}").suite == "gymnasium"
    options = {"env_type": "gymnasium", "seed": 1, "max_episode_steps": 10**6}
    theirs = envpool.make(task, num_envs=128, **options)
    # In envpool, a door at one of three places along a wall of four leads into a corner.
    assert 0.55 < solved(theirs, 128, 2000) < 0.8
    right = gym.make_vec(FARAMA, num_envs=16, vectorization_mode="sync", max_steps=10**6)
    assert solved(right, 16, 1500, seed=1) == 1
