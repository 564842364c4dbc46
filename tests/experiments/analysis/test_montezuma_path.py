import json

import numpy as np
import pytest

from experiments.analysis import go_explore
from experiments.analysis import montezuma_path as trajectory
from experiments.environments.pools import MONTEZUMA_ROOM
from experiments.system.errors import ConfigError


@pytest.fixture(scope="module")
def walk():
    return trajectory.load_committed_trajectory()


def test_load_committed_trajectory_is_long_and_visits_many_rooms(walk):
    assert walk.frames.shape == (2_700, 96, 96, 1)
    assert len(walk.action) == len(walk.room) == 2_699
    assert len(np.unique(walk.room)) >= 10
    stored = json.loads(trajectory.DATA.read_text())
    assert list(dict.fromkeys(walk.room.tolist())) == stored["rooms"]


def test_load_committed_trajectory_on_ale_py_visits_the_same_rooms(walk):
    """Compare the rooms with those of ALE, stepped directly without a pool."""
    emulator = go_explore.Emulator()
    rooms = [int(emulator.step(action)[MONTEZUMA_ROOM]) for action in walk.action.tolist()]
    np.testing.assert_array_equal(walk.room, rooms)


def test_load_committed_trajectory_wrong_actions_are_refused(tmp_path):
    stored = json.loads(trajectory.DATA.read_text())
    other = tmp_path / "other.json"
    other.write_text(json.dumps(stored | {"actions": "a" * 50}))
    with pytest.raises(ConfigError, match="leads to other frames"):
        trajectory.load_committed_trajectory(other)


def test_Search_actions_of_a_node_reach_its_emulator_state():
    search = go_explore.Search(0)
    for _ in range(12):
        search.explore(search.choose())
    assert len(search.nodes) > 3
    for node in (1, len(search.nodes) - 1):
        actions = search.actions(node)
        assert len(actions) == search.nodes[node].depth
        emulator = go_explore.Emulator()
        for action in actions:
            ram = emulator.step(action)
        emulator.ale.restoreState(search.nodes[node].state)
        np.testing.assert_array_equal(ram, emulator.ale.getRAM())


def test_Search_result_has_the_asked_number_of_states(monkeypatch):
    monkeypatch.setattr(go_explore, "STATES", 150)
    search = go_explore.Search(1)
    for _ in range(5):
        search.explore(search.choose())
    end = search.lengthen()
    assert len(search.actions(end)) == 149
