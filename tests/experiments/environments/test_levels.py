"""Fixed levels, held against the package minigrid step by step."""

import gymnasium as gym
import jax
import jax.numpy as jnp
import minigrid  # noqa: F401 (registers its tasks)
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from minigrid.core.world_object import Ball, Box, Door, Floor, Goal, Key, Lava, Wall

import sndjax
from experiments.environments.levels.dynamics import (
    LevelState,
    count_places,
    find_place,
    start_state,
    step_level,
)
from experiments.environments.levels.fixed_level import Level, encode_grid, load_level
from experiments.environments.levels.level_environment import make_level
from experiments.environments.levels.locked_rooms import LockedRooms
from experiments.environments.levels.views import make_map_view, make_pixel_view
from experiments.system.errors import ConfigError

COLOURS = ("red", "blue")
THINGS = {
    "empty": lambda colour: None,
    "wall": lambda colour: Wall(),
    "floor": Floor,
    "open": lambda colour: Door(colour, is_open=True),
    "closed": Door,
    "locked": lambda colour: Door(colour, is_locked=True),
    "key": Key,
    "ball": Ball,
    "box": Box,
    "full box": lambda colour: Box("red", contains=Key(colour)),
    "goal": lambda colour: Goal(),
    "lava": lambda colour: Lava(),
}
HANDS = ("empty", "key", "ball", "full box")
ID = "MiniGrid-KeyCorridorS3R3-v0"
step = jax.jit(step_level)


def read_state(env, width):
    """Return a task of minigrid as the fields of a `LevelState`, its carried object as a code."""
    column, row = env.agent_pos
    hands = env.carrying
    carrying = 0
    if hands is not None:
        env.grid.set(0, 0, hands)  # a wall, only to encode what is carried
        carrying = int(encode_grid(env)[0, 0])
        env.grid.set(0, 0, Wall())
    return (
        encode_grid(env).ravel(),
        int(row) * width + int(column),
        int(env.agent_dir),
        carrying,
        env.step_count,
    )


def fields(state):
    """Return the fields of a `LevelState` as NumPy's and Python's numbers."""
    return (np.asarray(state.grid), *(int(x) for x in state[1:]))


def assert_same(ours, theirs):
    """Assert that two states are equal in every field."""
    np.testing.assert_array_equal(ours[0], theirs[0])
    assert ours[1:] == theirs[1:]


@settings(max_examples=400, deadline=None)
@given(
    thing=st.sampled_from(sorted(THINGS)),
    colour=st.sampled_from(COLOURS),
    hands=st.sampled_from(HANDS),
    own=st.sampled_from(COLOURS),
    direction=st.integers(0, 3),
    action=st.integers(0, 5),
    asked=st.booleans(),
)
def test_step_level_any_cell_ahead_follows_minigrid(
    thing, colour, hands, own, direction, action, asked
):
    env = gym.make(ID).unwrapped
    env.reset(seed=0)
    row, column = 3, 3
    for x in range(1, env.width - 1):
        for y in range(1, env.height - 1):
            env.grid.set(x, y, None)
    env.agent_pos, env.agent_dir = (column, row), direction
    x, y = env.front_pos
    placed = THINGS[thing](colour)
    env.grid.set(x, y, placed)
    env.obj = placed if asked and thing in ("key", "ball", "box") else Ball("grey")
    env.carrying = THINGS[hands](own)
    level = Level(encode_grid(env), (row, column), direction, env.max_steps)
    before = read_state(env, env.width)
    state, reward, terminated, truncated = step(
        level, LevelState(*map(jnp.int32, before)), jnp.int32(action)
    )
    _, their_reward, their_end, their_limit, _ = env.step(action)
    assert_same(fields(state), read_state(env, env.width))
    assert (bool(terminated), bool(truncated)) == (their_end, their_limit)
    assert float(reward) == pytest.approx(their_reward, rel=1e-6)


@pytest.mark.parametrize(
    "name",
    [
        "MiniGrid-DoorKey-6x6-v0",
        "MiniGrid-LockedRoom-v0",
        "MiniGrid-KeyCorridorS4R3-v0",
        "MiniGrid-ObstructedMaze-2Dlhb-v0",
        "MiniGrid-LavaCrossingS9N1-v0",
    ],
)
def test_level_random_walk_follows_minigrid_to_the_limit(name):
    level = load_level(name, level=5, max_steps=300)
    env = gym.make(name, max_steps=300).unwrapped
    env.reset(seed=5)
    state, width = start_state(level), level.grid.shape[1]
    view = jax.jit(make_pixel_view(level, 4))
    random = np.random.default_rng(0)
    for t in range(300):
        action = int(random.integers(6))
        state, reward, terminated, truncated = step(level, state, jnp.int32(action))
        _, their_reward, their_end, their_limit, _ = env.step(action)
        assert_same(fields(state), read_state(env, width))
        assert (bool(terminated), bool(truncated)) == (their_end, their_limit)
        assert float(reward) == pytest.approx(their_reward, rel=1e-6)
        if t % 20 == 0:
            theirs = env.grid.render(4, env.agent_pos, env.agent_dir)
            ours = np.array(view(state))
            ours[:4, :4] = theirs[:4, :4]  # where we draw what is carried
            np.testing.assert_array_equal(ours, theirs)
        if terminated or truncated:
            break


def shortest_solution(env):
    """Return the actions that solve a task of LockedRooms, by breadth-first search of minigrid."""
    import copy

    seen, queue = set(), [(copy.deepcopy(env), ())]
    while queue:
        node, path = queue.pop(0)
        for action in range(6):
            after = copy.deepcopy(node)
            _, reward, ended, _, _ = after.step(action)
            if reward > 0:
                return (*path, action)
            grid, *rest = read_state(after, after.width)
            seen_as = (grid.tobytes(), *rest[:3])
            if not ended and seen_as not in seen:
                seen.add(seen_as)
                queue.append((after, (*path, action)))
    raise AssertionError("it cannot be solved")


def test_locked_rooms_solution_of_minigrid_solves_the_level_and_counts_its_doors():
    task = LockedRooms(rooms=2, size=2)
    task.reset(seed=3)
    solution = shortest_solution(task)
    env = make_level("LockedRooms", level=3, rooms=2, size=2)
    state, _ = env.reset(jax.random.key(0))
    doors = []
    for action in solution:
        state, _, reward, terminated, _ = env.step(jax.random.key(0), state, jnp.int32(action))
        doors.append(float(env.progress(state)))
    assert terminated
    assert float(reward) == pytest.approx(1 - 0.9 * len(solution) / task.max_steps)
    assert doors[0] == 0
    assert doors[-1] == 1
    assert doors == sorted(doors)


def test_locked_rooms_every_room_has_its_key_before_its_door():
    for rooms in (2, 4, 6, 9):
        task = LockedRooms(rooms=rooms)
        task.reset(seed=rooms)
        grid = encode_grid(task)
        assert ((grid & 15) == 4).sum() == rooms - 1  # doors
        assert ((grid & 15) == 8).sum() == 1  # the goal
        for room in range(rooms):
            x, y = task.corner(room)
            inside = grid[y : y + 3, x : x + 3]
            keys = inside[(inside & 15) == 5]
            assert len(keys) == (room < rooms - 1)
            around = grid[y - 1 : y + 4, x - 1 : x + 4]
            colours = {int(code >> 4) & 7 for code in around[(around & 15) == 4]}
            assert {int(code >> 4) & 7 for code in keys} <= colours


def test_find_place_cell_hands_and_doors_have_a_number_each():
    level = load_level("LockedRooms", rooms=3)
    start = start_state(level)
    numbers = set()
    doors = list(level.doors)
    for opened in range(len(doors) + 1):
        grid = start.grid
        for cell in doors[:opened]:
            grid = grid.at[cell].set(grid[cell] & ~(3 << 7))
        for hands in (0, *level.portable):
            for cell in level.floor:
                place = find_place(
                    level,
                    start._replace(grid=grid, carrying=jnp.int32(hands), position=jnp.int32(cell)),
                )
                numbers.add(int(place))
    assert numbers == set(range(count_places(level)))


def test_map_view_start_of_a_small_level_is_written_out():
    level = load_level("LockedRooms", rooms=2, size=2, level=3)
    seen = np.asarray(make_map_view(level)(start_state(level)))
    floor, (door,) = list(level.floor), level.doors
    agent = level.start[0] * level.grid.shape[1] + level.start[1]
    (key,) = np.flatnonzero((level.grid.ravel() & 15) == 5)
    expected = np.zeros((2, len(floor)))
    expected[0, floor.index(agent)] = expected[1, floor.index(key)] = 1
    direction = np.eye(4)[level.direction]
    assert door in floor
    np.testing.assert_array_equal(seen, [*expected.ravel(), 0, 0, 1, *direction, 0])


def test_collect_visits_count_the_states_of_a_python_loop():
    env = make_level("LockedRooms", rooms=2, size=2, max_steps=9)
    env = env._replace(progress=lambda state: state.position.astype(jnp.float32))
    live = sndjax.init_environments(env, jax.random.key(0), 3)
    seen = {int(env.place(jax.tree.map(lambda x, i=i: x[i], live.state))) for i in range(3)}
    progress, episodes = 0.0, 0
    advance = jax.jit(
        lambda live, action, key: sndjax.collecting.step_environments(env, live, action, key)
    )
    for t in range(60):
        action = jax.random.randint(jax.random.key(t), (3,), 0, 6)
        row, live = advance(live, action, jax.random.key(100 + t))
        for i in range(3):
            state = jax.tree.map(lambda x, i=i: x[i], live.state)
            seen.add(int(env.place(state)))
            if row.done[i]:
                progress, episodes = progress + float(env.progress(state)), episodes + 1
    assert set(np.flatnonzero(live.visits.visited)) == seen
    assert int(live.visits.episodes) == episodes > 10
    assert float(live.visits.progress) == progress > 0


@pytest.mark.parametrize("view", ["map", "pixels"])
def test_television_changes_every_step_and_nothing_else(view):
    plain = make_level("LockedRooms", view=view)
    noisy = make_level("LockedRooms", view=view, distractor="television")
    (state, before), (_, start) = (env.reset(jax.random.key(0)) for env in (noisy, plain))
    _, after, *_ = noisy.step(jax.random.key(1), state, jnp.int32(0))
    _, turned, *_ = plain.step(jax.random.key(1), state[0], jnp.int32(0))
    own = len(start)
    np.testing.assert_array_equal(before[:own], start)
    np.testing.assert_array_equal(after[:own], turned)
    assert (np.asarray(start) != np.asarray(turned)).any()
    assert (np.asarray(before[own:]) != np.asarray(after[own:])).mean() > 0.9
    assert noisy.num_places == plain.num_places
    assert int(noisy.place(state)) == int(plain.place(state[0]))


def test_colours_last_an_episode_and_keep_the_picture():
    env = make_level("LockedRooms", view="pixels", distractor="colours")
    plain = make_level("LockedRooms", view="pixels")
    (state, seen), (_, elsewhere) = (env.reset(jax.random.key(k)) for k in (0, 1))
    _, again, *_ = env.step(jax.random.key(2), state, jnp.int32(4))
    np.testing.assert_array_equal(seen, again)  # hands are empty: only the clock moved
    assert (np.asarray(seen) != np.asarray(elsewhere)).mean() > 0.9
    _, picture = plain.reset(jax.random.key(0))
    for channel in range(3):
        order = np.argsort(np.asarray(picture)[..., channel].ravel(), kind="stable")
        shown = np.asarray(seen)[..., channel].ravel()[order].astype(int)
        assert (np.diff(shown) <= 0).all() or (np.diff(shown) >= 0).all()


def test_colours_of_a_map_last_an_episode():
    env = make_level("LockedRooms", distractor="colours")
    (state, seen), (_, elsewhere) = (env.reset(jax.random.key(k)) for k in (0, 1))
    _, again, *_ = env.step(jax.random.key(2), state, jnp.int32(4))
    np.testing.assert_array_equal(seen, again)
    assert (np.asarray(seen[-24:]) != np.asarray(elsewhere[-24:])).all()
    np.testing.assert_array_equal(seen[:-24], elsewhere[:-24])


def test_sprites_of_a_map_walk_by_one_place():
    env = make_level("LockedRooms", distractor="sprites")
    state, seen = env.reset(jax.random.key(0))
    places = [np.argmax(np.asarray(seen[-24:]).reshape(3, 8), 1)]
    for t in range(40):
        state, seen, *_ = env.step(jax.random.key(t), state, jnp.int32(0))
        rings = np.asarray(seen[-24:]).reshape(3, 8)
        np.testing.assert_array_equal(rings.sum(1), 1)
        places.append(rings.argmax(1))
    ways = np.diff(places, axis=0) % 8
    assert set(ways.ravel()) == {1, 7}


def test_sprites_move_and_only_brighten():
    env = make_level("LockedRooms", view="pixels", distractor="sprites")
    _, plain = make_level("LockedRooms", view="pixels").reset(jax.random.key(0))
    state, first = env.reset(jax.random.key(0))
    _, second, *_ = env.step(jax.random.key(1), state, jnp.int32(4))
    assert 0 < (np.asarray(first) != np.asarray(second)).any(-1).sum() <= 2 * 3 * 16
    assert (np.asarray(first) >= np.asarray(plain)).all()


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("MiniGrid-DoorKey", {}, "did you mean MiniGrid-DoorKey"),
        ("MiniGrid-Fetch-5x5-N2-v0", {}, "rules of its own"),
        ("MiniGrid-Unlock-v0", {}, "rules of its own"),
        ("LockedRooms", {"view": "maps"}, "did you mean map"),
        ("LockedRooms", {"tile": 0, "view": "pixels"}, "tile=0: must be"),
        ("LockedRooms", {"distractor": "tv"}, "television"),
    ],
)
def test_make_level_wrong_argument_is_refused(name, options, message):
    with pytest.raises(ConfigError, match=message):
        make_level(name, **options)
