import numpy as np
import pytest
from helpers.run_files import made

from experiments.storage import read_runs
from experiments.storage.read_runs import RunReader, find_runs, group_runs, read_run
from experiments.system import display
from experiments.system.display import ProgressBars

CAR = ["env=MountainCar", "algo=rnd", "num_seeds=2"]
EPISODES = {0: [(64, 0.0, 0.0), (128, 1.0, 2.0)], 1: [(32, 1.0, 1.0)]}


def test_read_run_several_seeds_are_separate(tmp_path):
    run = read_run(made(tmp_path / "a", CAR, EPISODES, {0: [0.5, 0.25], 1: [0.5, None]}))
    first, second = run.seeds
    np.testing.assert_array_equal(first.episodes["ext_return"], [0, 1])
    np.testing.assert_array_equal(second.episodes["step"], [32])
    np.testing.assert_array_equal(first.metrics["step"], [128, 256])
    np.testing.assert_array_equal(second.metrics["int_reward_mean"], [0.5, np.nan])
    assert run.steps == 256


def test_find_runs_half_written_line_is_left_out_and_named(tmp_path):
    path = made(tmp_path / "a", CAR, EPISODES)
    for name, text in (("metrics.jsonl", '{"step": 3'), ("episodes.csv", "1,99,10,1")):
        with (path / name).open("a") as file:
            file.write(text)
    (run,), left_out = find_runs([tmp_path])
    assert [len(seed.metrics["step"]) for seed in run.seeds] == [2, 2]
    assert len(run.seeds[1].episodes["step"]) == 1
    assert [why for _, why in left_out] == [
        "the last line of metrics.jsonl is half written and left out",
        "the last line of episodes.csv is half written and left out",
    ]


def test_find_runs_seed_without_metrics_is_named(tmp_path):
    made(tmp_path / "a", CAR, EPISODES, {1: [0.5, 0.25]})
    runs, left_out = find_runs([tmp_path])
    (group,) = group_runs(runs)
    assert [seed.seed for seed in group.seeds] == [1]
    assert left_out == [(tmp_path / "a", "seed 0 has no line in metrics.jsonl and is left out")]


@pytest.mark.parametrize(
    ("name", "text", "why"),
    [
        ("metrics.jsonl", "no json\n", "line 1 of metrics.jsonl"),
        ("metrics.jsonl", "[1]\n", "line 1 of metrics.jsonl"),
        ("metrics.jsonl", "", "no iteration"),
        ("episodes.csv", "", "empty"),
        ("episodes.csv", "seed,step\n", "other columns"),
        ("episodes.csv", "seed,step\n1\n", "does not fit"),
        ("episodes.csv", "seed,step\n1\0" + 200_000 * "x" + "\n", "does not fit"),
        ("config.yaml", "- 1\n", "not a configuration"),
        ("config.yaml", "\0", "cannot be read"),
    ],
)
def test_find_runs_unreadable_run_is_left_out_and_named(tmp_path, name, text, why):
    made(tmp_path / "good", CAR, EPISODES)
    (made(tmp_path / "bad", CAR, EPISODES) / name).write_text(text)
    runs, ((path, said),) = find_runs([tmp_path])
    assert [run.path.name for run in runs] == ["good"]
    assert path.name == "bad"
    assert why in said


def test_find_runs_directory_without_runs_is_named(tmp_path):
    made(tmp_path / "a", CAR, EPISODES)
    (tmp_path / "empty").mkdir()
    places = [tmp_path / "a", tmp_path, tmp_path / "empty", tmp_path / "none"]
    runs, left_out = find_runs(places)
    assert len(runs) == 1  # given twice, read once
    assert [why for _, why in left_out] == ["no run in it", "there is no such directory"]


def test_group_runs_joins_seeds_and_separates_settings(tmp_path):
    made(tmp_path / "a", CAR, EPISODES)
    made(tmp_path / "b", ["env=MountainCar", "algo=rnd", "seed=5"], {5: EPISODES[0]})
    made(tmp_path / "c", [*CAR, "algo.eta=3"], EPISODES)
    made(tmp_path / "d", ["env=MountainCar", "algo=ppo"], {0: EPISODES[0]})
    groups = group_runs(find_runs([tmp_path])[0])
    found = {group.name: [seed.seed for seed in group.seeds] for group in groups}
    assert found.pop("rnd (eta=3.0)") == [0, 1]
    assert found.pop("ppo") == [0]
    ((name, seeds),) = found.items()
    assert name.startswith("rnd (eta=")
    assert sorted(seeds) == [0, 1, 5]


def test_find_runs_folder_of_links_reads_each_run_once(tmp_path):
    runs = [made(tmp_path / "store" / name, CAR, EPISODES) for name in ("a", "b")]
    links = tmp_path / "links"
    links.mkdir()
    for run in runs:
        (links / run.name).symlink_to(run)
    (links / "a again").symlink_to(runs[0])
    (links / "gone").symlink_to(tmp_path / "none")
    found, left_out = find_runs([links])
    assert [run.path for run in found] == [links / "a", links / "b"]
    assert [path for path, _ in left_out] == [links / "gone"]
    assert len(find_runs([links, tmp_path / "store"])[0]) == 2


def test_RunReader_unchanged_run_is_read_once_and_a_grown_one_again(tmp_path, monkeypatch):
    read, names = read_runs.read_run, []
    keep = lambda path, *rest: names.append(path.name) or read(path, *rest)
    monkeypatch.setattr(read_runs, "read_run", keep)
    made(tmp_path / "done", CAR, EPISODES)
    running = made(tmp_path / "running", CAR, EPISODES)
    reader = RunReader()
    assert [run.steps for run in find_runs([tmp_path], reader)[0]] == [256, 256]
    with (running / "metrics.jsonl").open("a") as file:
        file.write('{"step": 384, "seed": 0}\n')
    assert [run.steps for run in find_runs([tmp_path], reader)[0]] == [256, 384]
    assert names == ["done", "running", "running"]


def test_find_runs_with_bars_prints_the_progress(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(display, "QUIET_SECONDS", 0)
    for name in ("a", "b"):
        made(tmp_path / name, CAR, EPISODES)
    with ProgressBars() as bars:
        find_runs([tmp_path], None, bars)
    assert capsys.readouterr().out.splitlines() == [
        "reading runs: 0 of 2",
        "reading runs: 1 of 2",
        "reading runs: 2 of 2",
    ]


def test_group_runs_repeated_seed_is_kept_as_a_repeat_of_the_longest_run(tmp_path):
    made(tmp_path / "a", CAR, EPISODES, {0: [0.5], 1: [0.5]})
    made(tmp_path / "b", CAR, EPISODES, {0: [0.5] * 3, 1: [0.5] * 3})
    made(tmp_path / "c", ["env=MountainCar", "algo=rnd"], {0: EPISODES[0]})
    (group,) = group_runs(find_runs([tmp_path])[0])
    lengths = lambda seeds: [(seed.seed, int(seed.metrics["step"][-1])) for seed in seeds]
    assert lengths(group.seeds) == [(0, 384), (1, 384)]
    assert lengths(group.repeats) == [(0, 256), (0, 128), (1, 128)]
