"""The trial: a population equals ordinary runs, and its search and its files say what was run."""

import csv
import json
import os
import subprocess
import sys

import numpy as np
import pytest

from experiments.config.compose import load_config
from experiments.run import main as run_main
from experiments.system.errors import ConfigError
from experiments.trial import main
from experiments.trials import chance, launcher, tuning
from experiments.trials.page import write_page
from experiments.trials.population import Curve, Population
from experiments.trials.protocol import read_protocol
from experiments.trials.repeat import repeat_row
from experiments.trials.rows import bin_curve, complete_row, row_path, run_command
from experiments.trials.tables import read_rows
from experiments.trials.tuning import draw_settings, score_curve, tune

SMALL = ["env=levels", "env.id=MiniGrid-Empty-5x5-v0", "env.options.max_steps=20"]
AGENT = ["num_envs=32", "rollout_length=16", "ppo.minibatch_size=128"]
RUN = [*SMALL, *AGENT, "algo=snd_vic", "total_steps=4096"]


def log_of(path):
    """Return the lines of a run's log."""
    return [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]


def test_population_agents_with_numbers_equal_ordinary_runs(tmp_path):
    numbers = {"algo.eta": [0.5, 2.0], "algo.learning_rate": [1e-3, 1e-4]}
    numbers |= {"ppo.entropy_weight": [0.01, 0.001], "ppo.learning_rate": [1e-3, 3e-3]}
    population = Population(load_config([*RUN, "num_seeds=2"]))
    _, found = population.train(population.start([5, 9]), numbers)
    own = [f"{name}={values[1]}" for name, values in numbers.items()]
    assert run_main([*RUN, *own, "seed=9", f"run_dir={tmp_path}", "cores=1"]) == 0
    lines = log_of(tmp_path)
    assert len(lines) == 8
    assert found.coverage[1].tolist() == [line["coverage"] for line in lines]
    assert found.episodes[1].cumsum().tolist() == [line["episodes"] for line in lines]
    with (tmp_path / "episodes.csv").open() as file:
        won = sum(float(row["score"]) > 0 for row in csv.DictReader(file))
    assert found.solved[1].sum() == won > 0


def test_score_curve_counts_the_last_fifth_of_the_run():
    episodes = np.array([[9, 9, 9, 9, 9, 9, 9, 9, 3, 5], [1] * 8 + [0, 0]])
    solved = np.array([[0] * 8 + [1, 3], [1] * 8 + [0, 0]])
    coverage = np.cumsum(np.ones((2, 10)), 1)
    scores = score_curve(Curve(episodes, solved, coverage, coverage / 2, coverage))
    assert scores.solved.tolist() == [4 / 8, 0.0]  # the second agent ended no episode there
    assert scores.coverage.tolist() == [10, 10]
    assert scores.progress.tolist() == [5, 5]


def test_bin_curve_sums_episodes_and_reads_places_at_the_ends():
    each = np.arange(40.0)[None]
    found = bin_curve(Curve(each, each, each, each, each))
    assert found["episodes"] == [[2 * i + 2 * i + 1 for i in range(20)]]
    assert found["coverage"] == [[2 * i + 1 for i in range(20)]]


def test_draw_settings_same_for_methods_of_the_same_ranges_and_within_them():
    protocol = read_protocol()
    drawn = {name: draw_settings(m, protocol.settings) for name, m in protocol.methods.items()}
    assert drawn["snd_v"] == drawn["snd_vic"] == drawn["icm"]
    assert [s.numbers for s in drawn["rnd"]] == [s.numbers for s in drawn["snd_vic"]]
    for name, settings in drawn.items():
        method = protocol.methods[name]
        assert len(settings) == 32
        assert len({str(setting) for setting in settings}) == 32
        for option, (low, high) in method.numbers.items():
            values = np.log([setting.numbers[option] for setting in settings])
            assert np.log(low) <= values.min() < np.log(low) + 0.1 * np.log(high / low)
            assert np.log(high) >= values.max() > np.log(high) - 0.1 * np.log(high / low)
        for option, choices in method.choices.items():
            counts = [sum(s.choices[option] == choice for s in settings) for choice in choices]
            assert len(set(counts)) == 1


def test_tune_finds_the_best_by_solved_then_coverage(monkeypatch):
    protocol = read_protocol()._replace(settings=8, finalists=3, tuning_seeds=[0, 1, 2])
    method, task = protocol.methods["rnd"], next(iter(protocol.tasks.values()))
    settings = draw_settings(method, 8)
    solved = {0: [0.5, 0, 0], 1: [0.4, 0.4, 0.4], 2: [0.3, 0.5, 0.4], 3: [0.2, 1, 1]}
    seen = []

    def play(protocol, task, method, agents, report):
        rows = []
        for setting, seed in agents:
            i = settings.index(setting)
            seen.append((i, seed))
            rows.append((solved.get(i, [0, 0, 0])[seed], 10 * i))
        shape = lambda k: np.array([[row[k]] for row in rows], float)
        return Curve(np.ones((len(rows), 1)), shape(0), shape(1), shape(1), shape(1))

    monkeypatch.setattr(tuning, "train_settings", play)
    found = tune(protocol, task, method)
    assert seen[:8] == [(i, 0) for i in range(8)]
    assert sorted(seen[8:]) == [(i, seed) for i in (0, 1, 2) for seed in (1, 2)]
    assert found.setting == settings[2]  # as often solved as 1, with more places
    assert found.tried[1]["solved"] == [0.4, 0.4, 0.4]
    assert found.tried[5]["solved"] == [0]


def small_protocol():
    """Return the protocol with a task of a second and few agents."""
    protocol = read_protocol()
    task = next(iter(protocol.tasks.values()))
    small = task._replace(arguments=SMALL, steps=2048)
    few = {name: protocol.methods[name]._replace(choices={}) for name in ("rnd", "snd_vic")}
    return protocol._replace(
        common=AGENT,
        tasks={task.name: small},
        methods=few,
        settings=2,
        finalists=1,
        tuning_seeds=[0, 1],
        seeds=[7, 8],
    )


def test_complete_row_writes_its_search_and_seeds_which_page_and_repeat_show(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(chance, "STEPS", 2000)
    monkeypatch.setattr(chance, "ENVS", 100)
    protocol = small_protocol()
    (task,) = protocol.tasks.values()
    for name in ("rnd", "snd_vic"):
        complete_row(protocol, task, protocol.methods[name], tmp_path)
    found = json.loads(row_path(tmp_path, "rows", task, protocol.methods["rnd"]).read_text())
    assert found["seeds"] == [7, 8]
    assert len(found["solved"]) == len(found["curve"]["coverage"]) == 2
    searched = json.loads(row_path(tmp_path, "tuning", task, protocol.methods["rnd"]).read_text())
    assert len(searched["tried"]) == 2
    assert searched["numbers"] == found["numbers"]
    before = os.stat(row_path(tmp_path, "rows", task, protocol.methods["rnd"])).st_mtime_ns
    complete_row(protocol, task, protocol.methods["rnd"], tmp_path)
    assert os.stat(row_path(tmp_path, "rows", task, protocol.methods["rnd"])).st_mtime_ns == before
    assert "5 of 5 agents" in capsys.readouterr().out  # 2 settings, a finalist again, 2 seeds
    repeat_row(protocol, task, protocol.methods["rnd"], tmp_path, 1)
    seed, solved, stored, coverage, places = capsys.readouterr().out.splitlines()[4].split()
    assert (seed, float(solved)) == ("7", found["solved"][0])
    assert (solved, coverage) == (stored, places)
    chance.measure_chance(protocol, tmp_path)
    assert chance.read_chance(tmp_path)[task.name][0] >= 100
    write_page(protocol, tmp_path)
    page = (tmp_path / "rows.md").read_text()
    assert task.title in page
    assert "SND-VIC" in page
    assert (tmp_path / "images" / "seeds.png").stat().st_size > 1000


def write_row(out, protocol, task, method, solved, searched=0.0, covered=0):
    """Write the files of a row as if it had been run."""
    setting = draw_settings(method, protocol.settings)[0]
    count = len(solved)
    found = {
        "numbers": setting.numbers,
        "choices": setting.choices,
        "solved": solved,
        "coverage": [int(100 * x) for x in solved],
        "progress": solved,
        "finite": [True] * count,
        "curve": {name: [[1, 1]] * count for name in ("episodes", "solved")},
        "seconds": 1.0,
        "steps": task.steps,
        "command": run_command(protocol, task, method, setting, protocol.seeds[0]),
        "versions": {},
    }
    tried = [{"solved": [searched] * 5, "coverage": [covered]}, {"solved": [1.0], "coverage": [9]}]
    for stage, content in (("rows", found), ("tuning", {"tried": tried})):
        path = row_path(out, stage, task, method)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(content))


def test_write_page_answers_with_the_methods_against_rnd(tmp_path):
    protocol = read_protocol()
    first, second, *_ = protocol.tasks.values()
    scores = {
        "snd_v": [0.9, 0.8],
        "snd_std": [0.9, 0.8],
        "snd_vic": [0.0, 0.1],
        "snd_vinv": [0.5] * 2,
    }
    for task in (first, second):
        write_row(tmp_path, protocol, task, protocol.methods["rnd"], [0.5, 0.5])
        for name, solved in scores.items():
            best = (0.2, 9) if name == "snd_vic" else (0.2, 3)  # coverage decides between equals
            write_row(tmp_path, protocol, task, protocol.methods[name], solved, *best)
    write_page(protocol, tmp_path)
    page = (tmp_path / "rows.md").read_text()
    # 1, 1, 0 and 1/2, each the same in every resample; the best in the search is the worst here.
    assert (
        "SND-V, SND-STD, SND-VIC, SND-VINV > a run of RND), mean over methods and tasks | 0.62"
        in page
    )
    assert "best in the search of each task | 0.00 [0.00, 0.00] | no |" in page
    assert "2 tasks; 8 are not complete; intervals of 97.5%" in page
    assert "| SND-V | all | 2 | 0.85 [0.80, 0.90] | 0.50 [0.50, 0.50] | 1.00 [1.00, 1.00] |" in page
    assert (
        "| SND-VIC | all | 2 | 0.05 [0.00, 0.10] | 0.50 [0.50, 0.50] | 0.00 [0.00, 0.00] |" in page
    )


def test_read_rows_of_another_protocol_is_refused(tmp_path):
    protocol = read_protocol()
    task, method = protocol.find_row("rooms/rnd")
    write_row(tmp_path, protocol, task, method, [0.5])
    assert list(read_rows(protocol, tmp_path)) == [("rooms", "rnd")]
    changed = protocol._replace(common=[*protocol.common, "num_envs=16"])
    with pytest.raises(ConfigError, match="another protocol"):
        read_rows(changed, tmp_path)


def fake_row(code):
    """Return a function in place of `start_row` whose child runs a line of Python."""

    def start(task, method, out, core):
        name = f"{task.name}/{method.name}"
        log = out / name.replace("/", "-")
        with log.open("wb") as output:
            line = [sys.executable, "-c", f"name={name!r}; {code}"]
            return launcher.Running(name, subprocess.Popen(line, stdout=output), core, log)

    return start


def test_complete_rows_runs_as_many_as_cores_and_names_those_that_failed(
    tmp_path, monkeypatch, capsys
):
    rows = read_protocol().rows()[:4]
    code = "import sys; print('80 of 80 agents'); sys.exit('/rnd' in name)"
    at_once, start = [], fake_row(code)

    def counted(*args):
        at_once.append(args[3])
        return start(*args)

    monkeypatch.setattr(launcher, "start_row", counted)
    monkeypatch.setattr(launcher, "LOOK_SECONDS", 0.01)
    monkeypatch.setattr(launcher, "choose_cores", lambda jobs: [7, 8])
    failed = launcher.complete_rows(rows, tmp_path, 2)
    assert failed == [f"{rows[0][0].name}/rnd"]
    assert at_once[:2] == [7, 8]
    assert sorted(set(at_once)) == [7, 8]
    assert "80 of 80" in capsys.readouterr().out


def test_missing_rows_are_those_without_results(tmp_path):
    protocol = read_protocol()
    first, *others = protocol.rows()
    path = row_path(tmp_path, "rows", *first)
    path.parent.mkdir(parents=True)
    path.write_text("{}")
    assert launcher.missing_rows(protocol, tmp_path) == others


def test_trial_row_that_is_not_known_is_refused(tmp_path, capsys):
    assert main(["only=nowhere/rnd", f"out={tmp_path}"]) == 2
    assert "nowhere/rnd" in capsys.readouterr().err
    protocol = read_protocol()
    with pytest.raises(ConfigError, match="row of the trial"):
        protocol.find_row("rnd")
