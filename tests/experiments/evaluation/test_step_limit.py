"""Test what waits for an episode's end on a task whose episodes never end."""

import json
import tracemalloc

import numpy as np
import pytest
from helpers import endless_task

from experiments import analyze, evaluate, random_agent, record
from experiments.analysis.state_dataset import collect_states
from experiments.config.help import tool_help
from experiments.evaluation import players
from experiments.evaluation.players import load_players, play_episodes, step_limit
from experiments.run import main

ENDLESS = "helpers.endless_task:Endless-v0"
SMALL = ["num_envs=2", "rollout_length=16", "ppo.minibatch_size=32"]
SMALL += ["total_steps=32", "ppo.epochs=1"]


def trained(path, *arguments):
    assert main(["env=gymnasium", f"env.id={ENDLESS}", *SMALL, *arguments, f"run_dir={path}"]) == 0
    return path


@pytest.fixture(scope="module")
def vectors(tmp_path_factory):
    return trained(tmp_path_factory.mktemp("endless") / "run", "algo=rnd", "algo.minibatch_size=32")


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    more = ["algo=ppo", "env.options.image=true", "network=small"]
    return trained(tmp_path_factory.mktemp("images") / "run", *more)


def ending_once(monkeypatch, steps):
    """Let the first environment that is made end its episodes after some steps."""
    made = endless_task.Endless.__init__
    monkeypatch.setattr(endless_task.Endless, "made", 0)
    monkeypatch.setattr(
        endless_task.Endless, "__init__", lambda self, **more: made(self, **more, ends_after=steps)
    )


def test_play_episodes_without_end_are_cut_at_the_limit(vectors):
    (player,) = load_players(vectors, (ENDLESS,))
    for episode in play_episodes(player, 3, max_steps=40):
        assert not episode.complete
        assert episode.frames.shape == (41, 4)
        assert episode.reward.sum() == len(episode.action) == len(episode.value) == 40
        counted = (episode.frames > 0) @ [1, 2, 4, 8]
        np.testing.assert_array_equal(counted, np.arange(41) % 16)


def test_play_episodes_one_that_ends_is_complete_among_cut_ones(vectors, monkeypatch):
    (player,) = load_players(vectors, (ENDLESS,))
    pool = players.make_pool
    monkeypatch.setattr(
        players, "make_pool", lambda *given: (ending_once(monkeypatch, 7), pool(*given))[1]
    )
    played = play_episodes(player, 3, max_steps=20)
    assert sorted((len(e.action), e.complete) for e in played) == [
        (7, True),
        (20, False),
        (20, False),
    ]


def test_evaluate_without_end_stops_says_so_and_counts_the_complete(vectors, capsys):
    given = [str(vectors), f"env.id={ENDLESS}", "episodes=4", "max_steps=50"]
    assert evaluate.main(given) == 0
    out = capsys.readouterr().out
    assert "0 of 4 episodes complete" in out
    assert "4 of 4 episodes had no end after 50 steps and were cut (max_steps=50)" in out
    (line,) = json.loads(out.splitlines()[-1])["seeds"]
    assert (line["complete"], line["return"]["mean"], line["length"]["max"]) == (0, 50, 50)


def test_evaluate_help_names_the_limit_and_its_default():
    for tool in (evaluate, record):
        assert "max_steps=" in tool_help("", tool.Options)
    assert evaluate.Options().max_steps == players.MAX_STEPS


def test_record_without_end_films_the_cut_episode_and_says_so(images, tmp_path, capsys):
    given = [str(images), f"trust={ENDLESS}", "episodes=2", "max_steps=30", f"out={tmp_path}"]
    assert record.main(given) == 0
    out = capsys.readouterr().out
    assert "2 of 2 episodes had no end after 30 steps and were cut (max_steps=30)" in out
    assert "the best of 2, 0 complete" in out
    assert len([*tmp_path.glob("*.mp4")]) == 1


def test_record_frames_that_fill_the_memory_cut_the_episodes(images, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(players, "KEPT_BYTES", 2 * 25 * (64 * 64 * 3 + players.ROW_BYTES))
    given = [str(images), f"trust={ENDLESS}", "episodes=2", f"out={tmp_path}"]
    assert record.main(given) == 0
    said = "2 of 2 episodes had no end after 25 steps and were cut"
    assert f"{said} (they fill the memory: play fewer episodes)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("episodes", "frame"), [(1, 0), (16, 0), (1024, 0), (8, 96 * 96), (1024, 2**20)]
)
def test_step_limit_any_number_of_episodes_fits_the_memory(episodes, frame):
    limit = step_limit(10**9, episodes, frame)
    assert limit >= 1
    assert limit * episodes * frame <= max(players.KEPT_BYTES, episodes * frame)
    assert step_limit(100, 1, frame) == 100


def test_play_episodes_without_frames_keeps_less_memory_than_it_counts(images):
    (player,) = load_players(images, (ENDLESS,))
    most = {}
    for keep in (False, True):
        tracemalloc.start()
        play_episodes(player, 4, keep=keep, max_steps=800)
        most[keep] = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    frames = 4 * 800 * 64 * 64 * 3
    assert most[False] < frames / 4  # most of it is compiling
    assert most[True] > frames


def test_collect_states_without_end_gives_the_states_of_one_episode(vectors, capsys):
    (player,) = load_players(vectors, (ENDLESS,))
    states = collect_states(player, 120, seed=0)
    np.testing.assert_array_equal(states.age, np.arange(120))
    assert "cut" not in capsys.readouterr().out


def test_collect_states_full_memory_cuts_the_episodes_and_says_so(vectors, capsys, monkeypatch):
    monkeypatch.setattr(players, "KEPT_BYTES", 4 * 50 * (16 + players.ROW_BYTES))
    (player,) = load_players(vectors, (ENDLESS,))
    states = collect_states(player, 120, seed=0)
    np.testing.assert_array_equal(states.age, np.arange(120) % 50)
    assert "4 of 4 episodes had no end after 50 steps" in capsys.readouterr().out


def test_analyze_without_end_writes_its_page(vectors, tmp_path):
    given = [str(vectors), f"env.id={ENDLESS}", "states=100", f"out={tmp_path / 'page'}"]
    assert analyze.main(given) == 0
    assert (tmp_path / "page" / "index.html").is_file()


def test_random_agent_without_end_stops_and_says_what_it_saw(capsys):
    given = ["env=gymnasium", f"env.id={ENDLESS}", "num_envs=2", "total_steps=64"]
    assert random_agent.main([*given, "ppo.minibatch_size=64"]) == 2
    err = capsys.readouterr().err
    assert "no episode ended in 64 steps (the first reward by step 2)" in err
    assert "a task whose episodes end" in err
