"""The places of a level, and what is read of a module there, against values known in advance."""

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sndjax
from experiments.config.compose import load_config
from experiments.environments.levels.level_environment import make_level
from experiments.system.errors import ConfigError
from experiments.trials import places
from experiments.trials.causes import (
    Ground,
    find_ground,
    rank_correlation,
    read_agent,
    read_module,
    share_of_distractor,
    trace_causes,
)
from experiments.trials.places import steps_between, walk_level
from experiments.trials.protocol import read_protocol
from experiments.trials.tuning import Setting

GRID = 4


def walled_grid(end=-1):
    """Return a grid of cells with four moves, and a wall between its halves that has one gap.

    Args:
      end: the cell that ends an episode; -1: none.
    """

    def see(at):
        return jax.nn.one_hot(at, GRID * GRID)

    def step(key, at, action):
        row, column = at // GRID, at % GRID
        moves = jnp.array([[-1, 0], [1, 0], [0, -1], [0, 1]])
        to = jnp.clip(jnp.stack([row, column]) + moves[action], 0, GRID - 1)
        crosses = (row != to[0]) & (jnp.maximum(row, to[0]) == GRID // 2)
        blocked = crosses & (column != GRID - 1)
        at = jnp.where(blocked, at, to[0] * GRID + to[1]).astype(jnp.int32)
        return at, see(at), jnp.float32(0), at == end, jnp.zeros((), bool)

    reset = lambda key: (jnp.int32(0), see(0))
    return sndjax.JaxEnvironment(reset, step, 4, place=lambda at: at, num_places=GRID * GRID)


def expected_steps(source, target):
    """Return the steps between two cells of the walled grid, through the gap where needed."""
    (r, c), (s, d) = divmod(source, GRID), divmod(target, GRID)
    if (r < GRID // 2) == (s < GRID // 2):
        return abs(r - s) + abs(c - d)
    return abs(r - s) + (GRID - 1 - c) + (GRID - 1 - d)


def test_walk_and_steps_between_walled_grid_equal_the_closed_form():
    env = walled_grid()
    walk = walk_level(env)
    assert sorted(walk.places) == list(range(GRID * GRID))
    assert walk.steps.tolist() == [expected_steps(0, place) for place in walk.places]
    between = steps_between(env, walk, np.arange(len(walk.places)))
    for i, source in enumerate(walk.places):
        assert between[i].tolist() == [expected_steps(source, place) for place in walk.places]


def test_walk_level_does_not_leave_a_state_that_ends_an_episode():
    gap = GRID * GRID // 2 - 1  # the only way to the other half
    walk = walk_level(walled_grid(end=gap))
    assert sorted(walk.places) == list(range(GRID * GRID // 2))


def test_walk_level_empty_level_equals_a_search_in_minigrid():
    name = "MiniGrid-Empty-5x5-v0"
    walk = walk_level(make_level(name))
    env = gym.make(name).unwrapped
    env.reset(seed=0)
    start = (*map(int, env.agent_pos), int(env.agent_dir))
    best, queue = {start[:2]: 0}, [(start, 0)]
    seen = {start}
    while queue:  # of positions and directions; nothing else changes in this level
        (x, y, direction), depth = queue.pop(0)
        for action in range(3):
            env.agent_pos, env.agent_dir = (x, y), direction
            _, _, ended, _, _ = env.step(action)
            after = (*map(int, env.agent_pos), int(env.agent_dir))
            best.setdefault(after[:2], depth + 1)
            if after not in seen and not ended:
                seen.add(after)
                queue.append((after, depth + 1))
    assert sorted(walk.steps) == sorted(best.values())


def test_walk_level_too_many_states_is_refused(monkeypatch):
    monkeypatch.setattr(places, "MOST_STATES", 5)
    with pytest.raises(ConfigError, match="more than 5 states"):
        walk_level(walled_grid())


def ground_of(steps):
    """Return what is known of a level from the steps between its places."""
    count = steps.shape[1]
    frames = jnp.zeros((2, 2, count, 1))
    return Ground(np.arange(count), np.arange(len(steps)), steps, frames, jnp.zeros(count, int))


def test_rank_correlation_of_a_line_is_one_and_of_its_mirror_minus_one():
    line = np.arange(6.0)
    ground = ground_of(np.abs(line[:, None] - line[None]))
    assert rank_correlation(ground, line[:, None] ** 1.0) == pytest.approx(1)
    circle = ground_of(np.where(ground.steps == 5, np.inf, ground.steps))
    assert rank_correlation(circle, line[:, None]) == pytest.approx(1)
    far_is_near = ground_of(np.array([[0.0, 1, 2, 3]]))
    assert rank_correlation(far_is_near, np.array([[0.0], [3], [2], [1]])) == pytest.approx(-1)


def test_share_of_distractor_parts_of_known_variance():
    places_part = np.array([0.0, 2.0, 4.0, 6.0])  # variance 5
    draws_part = np.array([[-1.0], [1.0]])  # variance 1
    assert share_of_distractor(places_part + draws_part) == pytest.approx(1 / 6)
    assert share_of_distractor(np.ones((3, 4))) == 0


def test_read_agent_separates_what_was_visited():
    ground = ground_of(np.abs(np.arange(4.0)[:, None] - np.arange(4.0)[None]))
    visited = np.array([True, True, False, False])
    novelty = np.array([[1.0, 2.0, 2.0, 5.0]] * 2)
    found = read_agent(ground, visited, novelty, np.arange(4.0)[:, None])
    assert found["visited"] == 0.5
    assert (found["novelty_visited"], found["novelty_unvisited"]) == (1.5, 3.5)
    assert found["separation"] == pytest.approx(3.5 / 4)
    nothing = read_agent(ground, np.ones(4, bool), novelty, np.arange(4.0)[:, None])
    assert nothing["separation"] is None
    assert nothing["novelty_unvisited"] is None


def test_read_module_of_distillation_is_its_error_on_the_first_of_the_two_frames():
    module = sndjax.rnd(4, sndjax.VECTOR)
    network = sndjax.ActorCritic(sndjax.VECTOR, 4, 2)
    agent = sndjax.AgentSpec(network, sndjax.Hyperparameters(), sndjax.IntrinsicConfig(module))
    state = sndjax.init_train_state(agent, jax.random.key(0), jnp.zeros((3, 5)))
    frames = jax.random.normal(jax.random.key(1), (2, 2, 3, 5))
    action = jnp.zeros(3, jnp.int32)
    novelty, features = read_module(agent, state, frames, action)
    for draw in range(2):
        alone, _ = read_module(agent, state, frames[draw][None, [0, 0]], action)
        np.testing.assert_allclose(novelty[draw], alone[0], rtol=1e-5)
    np.testing.assert_allclose(
        features,
        module.features(state.intrinsic, state.intrinsic_state, frames[0, 0], action),
        rtol=1e-5,
    )


def test_trace_causes_small_level_reads_every_figure_at_every_tenth():
    protocol = read_protocol()
    protocol = protocol._replace(
        common=["num_envs=32", "rollout_length=16", "ppo.minibatch_size=128"]
    )
    task, method = protocol.find_row("rooms_television/snd_vic")
    small = ["env=levels", "env.id=MiniGrid-Empty-5x5-v0", "env.options.distractor=television"]
    task = task._replace(arguments=small, steps=5120)
    setting = Setting({"algo.eta": 1.0, "algo.learning_rate": 1e-3}, {"algo.minibatch_size": 128})
    found = trace_causes(protocol, task, method, setting)
    assert {len(own) for rows in found.values() for own in rows} == {11}
    assert all(own[0] == 1 / 9 for own in found["visited"])  # the start alone
    assert all(own[-1] > 0.5 for own in found["visited"])
    assert all(0 < share < 1 for own in found["distractor_share"] for share in own)
    assert len({own[5] for own in found["rank_correlation"]}) == 4


@pytest.mark.parametrize("distractor", ["television", "sprites", "colours"])
def test_find_ground_draws_what_a_distractor_adds_and_nothing_else(distractor):
    arguments = ["env=levels", "env.id=MiniGrid-Empty-5x5-v0", "algo=rnd"]
    config = load_config([*arguments, f"env.options.distractor={distractor}"])
    plain = find_ground(load_config(arguments), jnp.asarray)
    ground = find_ground(config, jnp.asarray)
    own = plain.frames.shape[-1]
    np.testing.assert_array_equal(ground.frames[..., :own], plain.frames)
    added = np.asarray(ground.frames[..., own:])  # [draws, here and after, places, numbers]
    assert added.shape[-1] == 24
    assert len({draw.tobytes() for draw in added[:, 0, 0]}) > 4
    np.testing.assert_array_equal(added, np.broadcast_to(added[:, :, :1], added.shape))
    moved = (added[:, 0] != added[:, 1]).any()
    assert moved == (distractor != "colours")


def test_find_ground_distractor_within_images_is_refused():
    arguments = ["env=levels", "env.id=MiniGrid-Empty-8x8-v0", "env.options.view=pixels"]
    arguments += ["algo=rnd", "network=small", "env.options.distractor=colours"]
    with pytest.raises(ConfigError, match="within images"):
        find_ground(load_config(arguments), jnp.asarray)
