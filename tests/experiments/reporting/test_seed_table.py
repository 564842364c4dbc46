"""docs/results/explores.md: its tables made again from raw figures, and one seed trained again."""

import json
import re
import subprocess
import sys

import cv2
import numpy as np
import pytest
from helpers.processes import ROOT
from helpers.run_files import made

from experiments.reporting import seed_table
from experiments.reporting.seed_table import draw_seeds, load_summaries, markdown_table, table_rows
from experiments.seed_table import main
from experiments.storage import read_configs

RESULTS = ROOT / "docs" / "results"
RAW = sorted((RESULTS / "explores").glob("*.json"))


# The mean return that counts as reaching the goal, where it is not 0.9.
GOALS = {"cartpole": 475.0, "coinrun": 5.0, "coinrun_level_0": 5.0, "ablations": 5.0}


def lines(raw):
    return markdown_table(json.loads(raw.read_text()), GOALS.get(raw.stem, 0.9))


@pytest.mark.parametrize("raw", RAW, ids=lambda path: path.stem)
def test_seed_table_committed_raw_figures_give_the_tables_of_the_page(raw):
    page = (RESULTS / "explores.md").read_text().splitlines()
    assert len(lines(raw)) > 2
    assert set(lines(raw)) <= set(page)
    assert raw.with_suffix(".png").is_file()
    assert f"explores/{raw.name}" in "\n".join(page)


def test_seed_table_committed_lines_all_have_raw_figures():
    page = (RESULTS / "explores.md").read_text().splitlines()
    shown = {
        line for line in page if line.startswith("| `") and re.search(r"\| \d of [2-9] \|", line)
    }
    known = {line for raw in RAW for line in lines(raw) if line.startswith("| `")}
    assert shown == known


def test_seed_table_minigrid_overview_has_the_same_figures():
    page = (RESULTS / "explores.md").read_text()
    _, begin, rest = page.partition("| seeds of five that solve it")
    head, _, *shown = (begin + rest.partition("\n\n")[0]).splitlines()
    parts = lambda line: [part.strip() for part in line.strip("|").split("|")]
    files = {"DoorKey-8x8": "doorkey", "MultiRoom-N4-S5": "multiroom_n4"}
    files |= {"MultiRoom-N6": "multiroom", "KeyCorridorS3R3": "keycorridor"}
    levels = [files.pop(level.partition(",")[0]) for level in parts(head)[1:]]
    assert not files  # every level has a column
    for column, level in enumerate(levels, start=1):
        raw = json.loads((RESULTS / "explores" / f"{level}.json").read_text())
        expected = {}
        for name in {key.split("/")[1] for key in raw}:
            last = [run["last100_ext_return"] for key, run in raw.items() if f"/{name}/" in key]
            reached = sum(value >= 0.9 for value in last)
            expected[name] = f"{reached}/{len(last)}, {np.mean(last):.2f}"
        found = {parts(line)[0]: parts(line)[column] for line in shown}
        assert {name: value for name, value in found.items() if value != "not run"} == expected


def summed(path, arguments, returns, steps=1_003_520):
    """Write a run directory with a summary; `returns` maps seeds to their last-100 return."""
    made(
        path,
        arguments,
        {seed: [(64, value or 0.0, value or 0.0)] for seed, value in returns.items()},
    )
    seeds = [
        {
            "seed": seed,
            "steps": steps,
            "mean_ext_return": value and value / 2,
            "last100_ext_return": value,
        }
        | {"wall_seconds": 10.0 + seed}
        for seed, value in returns.items()
    ]
    (path / "summary.json").write_text(json.dumps({"seeds": seeds}))


GRID = ["env=MountainCar", "algo=grid", "algo.objective=vicreg", "algo.signal=ngu"]


@pytest.fixture
def sweep(tmp_path):
    place = tmp_path / "sweep" / "MountainCar"
    summed(place / "ppo" / "0", ["env=MountainCar", "algo=ppo"], {0: 0.0})
    summed(place / "ppo" / "1", ["env=MountainCar", "algo=ppo", "seed=1"], {1: 0.0})
    summed(place / "grid" / "0,algo.signal=ngu,algo.eta=3", [*GRID, "algo.eta=3"], {0: 1.0})
    two = ["env=MountainCar", "algo=rnd", "num_seeds=2"]
    summed(place / "rnd" / "20261122-173225-418c", two, {0: 0.95, 1: 0.5})
    summed(place / "sp" / "0", ["env=MountainCar", "algo=sp"], {0: None})
    summed(place / "icm" / "0", ["env=MountainCar", "algo=icm"], {0: 1.0}, steps=4096)
    return tmp_path / "sweep"


def test_seed_table_unfinished_run_of_a_sweep_is_named(sweep, tmp_path, capsys):
    assert main([str(sweep), "--out", str(tmp_path / "made")]) == 0
    printed = capsys.readouterr()
    end = "mean [95%] | at least 0.9 | mean of all episodes | median s |"
    assert printed.out.splitlines() == [
        f"| MountainCar | seed 0 | {end}",
        "|---|---|---|---|---|---|",
        "| `vicreg+ngu eta=3` | 1.00 | 1.00 | 1 of 1 | 0.50 | 10 |",
        "",
        f"| MountainCar | seed 0 | 1 | {end}",
        "|---|---|---|---|---|---|---|",
        "| `ppo` | 0.00 | 0.00 | 0.00 [0.00, 0.00] | 0 of 2 | 0.00 | 10 |",
        "| `rnd` | 0.95 | 0.50 | 0.72 [0.50, 0.95] | 1 of 2 | 0.36 | 10 |",
        "",
        f"| MountainCar | seed 0 | {end}",
        "|---|---|---|---|---|---|",
        "| `sp` | - | - | 0 of 1 | 0.00 | 10 |",
    ]
    *progress, line = printed.err.splitlines()
    assert progress == ["reading runs: 0 of 6", "reading runs: 6 of 6"]
    assert line.startswith("not finished: ")
    assert line.endswith("MountainCar/icm/0")
    assert main([str(tmp_path / "made.json")]) == 0  # the written file gives the same table
    assert capsys.readouterr().out == printed.out


def test_seed_table_picture_has_a_dot_for_every_seed(sweep, tmp_path, monkeypatch):
    figures = []
    save = seed_table.save_figure
    keep = lambda figure, *rest, **of: figures.append(figure) or save(figure, *rest, **of)
    monkeypatch.setattr(seed_table, "save_figure", keep)
    summaries = load_summaries([sweep]).summaries
    draw_seeds(summaries, 0.9, tmp_path / "picture")
    (axes,) = figures[0].axes
    dots = [list(line.get_xdata()) for line in axes.lines if line.get_marker() == "o"]
    assert len(dots) == len(table_rows(summaries))
    for shown, row in zip(dots[::-1], table_rows(summaries), strict=True):
        np.testing.assert_array_equal(shown, row.last())
    assert [tick.get_text() for tick in axes.get_yticklabels()][::-1] == [
        row.name for row in table_rows(summaries)
    ]
    assert cv2.imread(str(tmp_path / "picture.png")).std() > 0


@pytest.mark.filterwarnings("error::UserWarning")  # matplotlib warns if axes have no space
def test_seed_table_picture_long_name_leaves_room_for_the_axes(tmp_path, monkeypatch):
    figures = []
    save = seed_table.save_figure
    keep = lambda figure, *rest, **of: figures.append(figure) or save(figure, *rest, **of)
    monkeypatch.setattr(seed_table, "save_figure", keep)
    run = {"seed": 0, "last100_ext_return": 1.0}
    settings = ",".join(f"setting_{i}={i}" for i in range(12))
    draw_seeds({f"MountainCar/rnd/0,{settings}": run}, 0.9, tmp_path / "picture")
    (axes,) = figures[0].axes
    (shown,) = [tick.get_text() for tick in axes.get_yticklabels()]
    assert shown.split() == ["rnd", *settings.split(",")]
    assert axes.get_position().width > 0.3


def test_seed_table_two_runs_of_one_name_are_refused(sweep, capsys):
    other = sweep / "again" / "0"
    summed(other, ["env=MountainCar", "algo=ppo", "ppo.clip=0.2"], {0: 0.5})
    assert main([str(sweep)]) == 2
    assert "is a second run called MountainCar/ppo/0" in capsys.readouterr().err
    table_of = str(RESULTS / "explores" / "mask.json")
    assert main([table_of, table_of]) == 2
    assert "is a second run called" in capsys.readouterr().err


def test_seed_table_folder_of_links_gives_the_table_of_the_runs(sweep, tmp_path, capsys):
    assert main([str(sweep)]) == 0
    direct = capsys.readouterr().out
    links = tmp_path / "links"
    links.mkdir()
    for i, run in enumerate(sorted(sweep.glob("*/*/*"))):
        (links / f"{i}").symlink_to(run)
        (links / f"{i} again").symlink_to(run)
    (links / "circle").symlink_to(tmp_path)
    (links / "gone").symlink_to(tmp_path / "moved")
    assert main([str(links)]) == 0
    linked = capsys.readouterr()
    assert sorted(linked.out.split("\n\n")) == sorted(direct.split("\n\n"))
    assert f"left out: {links / 'gone'}: a symbolic link to nothing" in linked.err


def test_seed_table_seeds_that_end_at_different_steps_says_at_which(tmp_path, capsys):
    for seed, steps in ((0, 1_003_520), (1, 2_007_040)):
        place = tmp_path / "MountainCar" / "ppo" / str(seed)
        summed(place, ["env=MountainCar", "algo=ppo", f"seed={seed}"], {seed: 0.0}, steps)
    assert main([str(tmp_path)]) == 0
    expected = "`ppo` on MountainCar: the seeds end at 1.00352 and 2.00704 million steps."
    assert capsys.readouterr().out.splitlines()[-2:] == ["", expected]


def test_load_summaries_runs_of_a_sweep_parses_one_configuration_for_all_seeds(
    tmp_path, monkeypatch
):
    parsed = []
    parse = read_configs.parse_saved
    keep = lambda text, where: parsed.append(where) or parse(text, where)
    monkeypatch.setattr(read_configs, "parse_saved", keep)
    for seed in range(6):
        place = tmp_path / "MountainCar" / "ppo" / str(seed)
        summed(place, ["env=MountainCar", "algo=ppo", f"seed={seed}"], {seed: 0.0})
    assert len(load_summaries([tmp_path]).summaries) == 6
    assert len(parsed) == 1


def test_seed_table_directory_without_finished_run_is_refused(tmp_path, capsys):
    assert main([str(tmp_path)]) == 2
    assert "no finished run in" in capsys.readouterr().err


def test_run_snd_vic_on_mountain_car_reaches_the_goal_as_in_the_table(tmp_path):
    command = [sys.executable, "-m", "experiments.run", "-m", "sweep=small", "algo=snd_vic"]
    command += ["seed=0", f"hydra.sweep.dir={tmp_path / 'sweep'}", "hydra.launcher.n_jobs=2"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    (summary,) = (tmp_path / "sweep").rglob("summary.json")
    (found,) = json.loads(summary.read_text())["seeds"]
    assert found["steps"] == 1_003_520
    assert found["last100_ext_return"] >= 0.9  # 1.00 in the table
