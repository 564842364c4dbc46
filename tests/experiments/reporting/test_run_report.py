import csv
import itertools
import json
import re
import shutil
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from helpers.run_files import made

from experiments import report
from experiments.report import main
from experiments.reporting import seed_statistics
from experiments.reporting.learning_curves import QUANTITIES, draw_curves
from experiments.reporting.thesis_tables import improvement_table, seeds_table, thesis_table
from experiments.storage import read_configs, read_runs
from experiments.storage.read_runs import find_runs, group_runs
from experiments.system import display

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


@pytest.fixture
def runs(tmp_path):
    """Write runs of RND (two seeds) and PPO (one) on MountainCar, and of SND-VIC on Venture."""
    place = tmp_path / "runs"
    made(
        place / "rnd",
        ["env=MountainCar", "algo=rnd", "num_seeds=2"],
        {0: [(64, 0.0, 0.0), (128, 1.0, 0.0)], 1: [(100, 1.0, 0.0)]},
    )
    made(place / "ppo", ["env=MountainCar", "algo=ppo"], {0: [(64, 0.0, 0.0), (256, 0.0, 0.0)]})
    made(
        place / "venture",
        ["env=Venture", "algo=snd_vic", "num_seeds=2"],
        {0: [(64, 3.0, 300.0), (128, 1.0, 100.0)], 1: [(100, 1.0, 700.0)]},
    )
    return place


def rows_of(table):
    return {tuple(row[:2]): row[2:] for row in table.rows}


def test_thesis_tables_made_up_runs_match_hand_computed_tables(runs):
    groups = group_runs(find_runs([runs])[0])
    mine = rows_of(thesis_table("5.6", groups))
    # The mean returns of the two seeds are 2 and 1; ± is the population standard deviation.
    assert mine["Venture", "SND-VIC"][:3] == ["1.50 ± 0.50", "2", "0.000256"]
    assert mine["Venture", "SND-VIC"][3] == "11.36 ± 0.37"
    assert mine["Venture", "RND"][:3] == ["", "", ""]
    best = rows_of(thesis_table("5.7", groups))
    assert best["Venture", "SND-VIC"][:2] == ["500.00 ± 200.00", "2"]
    over = rows_of(seeds_table(groups))
    assert over["MountainCar", "RND"][:2] == ["2", "0.75"]
    chances = improvement_table(groups)
    assert chances.head == ["", "ppo", "rnd", "snd_vic"]
    assert chances.rows[1] == ["rnd", "1.00", "", ""]  # no environment in common with snd_vic


def test_thesis_table_without_runs_shows_the_published_numbers(runs):
    with open("experiments/data/thesis.csv", newline="") as file:
        known = [row for row in csv.DictReader(file) if row["table"] == "5.8"]
    table = thesis_table("5.8", [])
    assert len(table.rows) == len(known)
    for row, number in zip(table.rows, known, strict=True):
        assert row[0] == number["env"]
        assert float(row[-1].split(" ± ")[0]) == float(number["value"])


def test_report_of_runs_writes_page_pictures_and_tables(runs, tmp_path, capsys):
    (runs / "half").mkdir()
    (runs / "half" / "config.yaml").write_text("{}")
    out = tmp_path / "out"
    assert main([str(runs), "--out", str(out)]) == 0
    page, said = (out / "index.html").read_text(), capsys.readouterr().out
    assert page.count("<img") == 6  # returns, scores and novelty of two environments
    assert not re.search(r'(src|href)="(?!data:|#)', page)  # the page loads no other file
    for text in ("MountainCar", "Table 5.6", "Left out", "/half"):
        assert text in page
    assert "left out: " in said
    names = {path.name for path in out.iterdir()}
    assert {"Venture-score.svg", "Venture-score.png", "table-5.7.csv", "seeds.csv"} <= names
    with (out / "table-5.6.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [r["ours"] for r in rows if r["ours"]] == ["1.50 ± 0.50"]


def test_report_directory_without_runs_exits_with_status_2(tmp_path, capsys):
    assert main([str(tmp_path), f"out={tmp_path / 'out'}"]) == 2
    assert "nothing to report" in capsys.readouterr().err
    assert main(["out=x"]) == 2


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium")
@pytest.mark.parametrize("size", ["1280,900", "390,844"])
def test_report_page_is_shown_by_a_browser(runs, tmp_path, size):
    out = tmp_path / "out"
    assert main([str(runs), f"out={out}"]) == 0
    page = out / "index.html"
    # This script writes counts of pictures and the overflow into the page, for --dump-dom.
    probe = """<script>addEventListener('load', () => { const i = [...document.images];
      document.body.innerHTML = JSON.stringify({pictures: i.length,
        loaded: i.filter(x => x.complete && x.naturalWidth > 0).length,
        overflow: document.documentElement.scrollWidth - innerWidth}) })</script>"""
    probed = out / "probed.html"
    probed.write_text(page.read_text().replace("</body>", f"{probe}</body>"))
    flags = ["--headless", "--no-sandbox", "--disable-gpu", f"--window-size={size}"]
    flags += ["--enable-logging=stderr", "--v=0", f"--user-data-dir={tmp_path / 'profile'}"]
    shown = subprocess.run(
        [CHROMIUM, *flags, "--dump-dom", probed.as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    assert "CONSOLE" not in shown.stderr
    found = json.loads(
        shown.stdout[shown.stdout.index('{"pictures"') : shown.stdout.rindex("}") + 1]
    )
    assert found["pictures"] == found["loaded"] == 6
    assert found["overflow"] <= 0


def test_draw_curves_several_seeds_is_their_mean(runs, tmp_path):
    group = next(g for g in group_runs(find_runs([runs])[0]) if g.name == "rnd")
    steps, values = QUANTITIES["return"].of(group.seeds[0])
    np.testing.assert_allclose(values, [0.0, 0.01])
    np.testing.assert_array_equal(steps, [64, 128])
    assert QUANTITIES["rooms"].of(group.seeds[0]) is None
    assert (
        draw_curves([group], "return", "$x", tmp_path, "curve").read_bytes().startswith(b"\x89PNG")
    )
    with (tmp_path / "curve.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    # The second seed has its only episode at step 100. Both seeds were trained until step 256.
    found = [(float(row["step"]), float(row["mean"]), row["seeds"]) for row in rows]
    assert found == [(64, 0.0, "1"), (100, 0.5, "2"), (128, 0.505, "2"), (256, 0.505, "2")]


def test_draw_curves_return_always_zero_is_drawn(tmp_path):
    made(tmp_path / "ppo", ["env=MountainCar", "algo=ppo"], {0: [(64, 0.0, 0.0)]}, {0: [0.0, 0.0]})
    log = tmp_path / "ppo" / "metrics.jsonl"
    lines = [
        json.loads(line) | {"last100_ext_return": 0.0} for line in log.read_text().splitlines()
    ]
    log.write_text("".join(json.dumps(line) + "\n" for line in lines))
    groups = group_runs(find_runs([tmp_path])[0])
    draw_curves(groups, "last100", "title", tmp_path, "curve")
    assert {row["mean"] for row in csv.DictReader((tmp_path / "curve.csv").open())} == {"0.0"}
    assert (
        draw_curves(groups, "intrinsic", "title", tmp_path, "none") is None
    )  # PPO has no intrinsic reward


def test_tables_repeated_seed_is_counted_once_and_named(runs, tmp_path):
    made(runs / "again", ["env=Venture", "algo=snd_vic"], {0: [(9, 9.0, 9.0)]}, {0: [0.5]})
    made(runs / "without", ["env=Venture", "algo=snd_vic", "seed=7"], {7: []}, {7: [0.5]})
    groups = group_runs(find_runs([runs])[0])
    mine = rows_of(thesis_table("5.6", groups))
    ends = "0.000128 and 0.000256 (2 seeds)"
    assert mine["Venture", "SND-VIC"][:3] == ["1.50 ± 0.50", "2", ends]
    assert rows_of(seeds_table(groups))["Venture", "SND-VIC"][-2:] == [ends, "1"]
    assert rows_of(seeds_table(groups))["MountainCar", "RND"][-2:] == ["0.000256", "0"]
    assert main([str(runs), f"out={tmp_path / 'out'}"]) == 0
    with (tmp_path / "out" / "runs.csv").open(newline="") as file:
        repeats = {Path(row["run"]).name: row["repeats"] for row in csv.DictReader(file)}
    assert repeats.pop("again") == "seed 0"
    assert set(repeats.values()) == {""}
    page = (tmp_path / "out" / "index.html").read_text()
    assert "A repeat is a run with the settings and the seed of another run" in page
    assert "SND-VIC: repeated runs of seed 0, which the mean leaves out." in page


def test_report_seeds_that_end_at_different_steps_says_at_which(tmp_path):
    for seed, iterations in ((0, 577), (1, 16)):
        episodes = {seed: [(1000, 0.9 * (1 - seed), 0.0)]}
        novelty = {seed: [0.5] * iterations}
        options = ["env=MountainCar", "algo=rnd", f"seed={seed}"]
        made(tmp_path / "runs" / str(seed), options, episodes, novelty, rows=1000)
    assert main([str(tmp_path / "runs"), f"out={tmp_path / 'out'}"]) == 0
    page = (tmp_path / "out" / "index.html").read_text()
    assert "RND: its seeds end at 0.016 and 0.577 million steps." in page
    assert "not all runs have the same number of steps" in page
    with (tmp_path / "out" / "seeds.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert row["seeds end at, million steps"] == "0.016 and 0.577"


def test_report_of_a_sweep_has_a_column_for_each_setting_that_differs(tmp_path):
    cell = ["env=MountainCar", "algo=grid", "algo.objective=none", "algo.signal=noveld"]
    for i, more in enumerate((["signal.alpha=0.3"], ["signal.alpha=0.5", "network.hidden=[8]"])):
        made(tmp_path / "runs" / str(i), [*cell, *more], {0: [(64, 1.0, 0.0)]})
    assert main([str(tmp_path / "runs"), f"out={tmp_path / 'out'}"]) == 0
    with (tmp_path / "out" / "runs.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["signal.alpha"], row["network.hidden"]) for row in rows] == [
        ("0.3", "None"),
        ("0.5", "[8]"),
    ]
    assert not {"algo.signal", "signal.centre", "env.id"} & set(rows[0])
    assert "signal.alpha" in (tmp_path / "out" / "index.html").read_text()


def test_report_runs_of_equal_length_says_nothing_of_steps(runs, tmp_path):
    assert main([str(runs), f"out={tmp_path / 'out'}"]) == 0
    page = (tmp_path / "out" / "index.html").read_text()
    assert "end at 0" not in page
    assert "not all runs have the same" not in page


def test_report_folder_of_links_equals_the_report_of_the_runs(runs, tmp_path):
    links = tmp_path / "links"
    links.mkdir()
    for run in runs.iterdir():
        (links / run.name).symlink_to(run)
    (links / "circle").symlink_to(links)
    for place, out in ((runs, "direct"), (links, "linked")):
        assert main([str(place), f"out={tmp_path / out}"]) == 0
    for table in ("seeds", "improvement", "table-5.6"):
        direct = (tmp_path / "direct" / f"{table}.csv").read_text()
        assert (tmp_path / "linked" / f"{table}.csv").read_text() == direct


def test_report_live_page_reads_unchanged_runs_once(runs, tmp_path, monkeypatch, capsys):
    read, names, waited = read_runs.read_run, [], []
    keep = lambda path, *rest: names.append(path.name) or read(path, *rest)
    monkeypatch.setattr(read_runs, "read_run", keep)

    def wait(seconds):
        waited.append(seconds)
        if len(waited) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(report.time, "sleep", wait)
    assert main([str(runs), f"out={tmp_path / 'out'}", "live=true"]) == 130
    assert capsys.readouterr().out.count("page: ") == 2
    assert sorted(names) == ["ppo", "rnd", "venture"]


def test_report_shows_the_progress_of_each_part(runs, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(display, "QUIET_SECONDS", 0)
    assert main([str(runs), f"out={tmp_path / 'out'}"]) == 0
    lines = capsys.readouterr().out.splitlines()
    for name, count in (("reading runs", 3), ("drawing", 8), ("comparing", 3)):
        expected = [f"{name}: {i} of {count}" for i in range(count + 1)]
        assert [line for line in lines if line.startswith(name)] == expected


def test_report_many_runs_parses_and_compares_little(tmp_path, monkeypatch):
    parsed, compared = [], []
    parse, compare = read_configs.parse_saved, seed_statistics.compare_pairs
    keep = lambda text, where: parsed.append(where) or parse(text, where)
    monkeypatch.setattr(read_configs, "parse_saved", keep)
    count = lambda ours, theirs: compared.append(1) or compare(ours, theirs)
    monkeypatch.setattr(seed_statistics, "compare_pairs", count)
    for algo in ("ppo", "rnd", "icm"):
        options = ["env=MountainCar", f"algo={algo}"]
        first = made(tmp_path / "runs" / algo / "0", options, {0: [(64, 0.0, 0.0)]})
        for seed in range(1, 8):
            again = tmp_path / "runs" / algo / str(seed)
            shutil.copytree(first, again)
            for name, old, new in (
                ("config.yaml", "\nseed: 0\n", f"\nseed: {seed}\n"),
                ("episodes.csv", "\n0,", f"\n{seed},"),
                ("metrics.jsonl", '"seed": 0', f'"seed": {seed}'),
            ):
                text = (again / name).read_text()
                assert old in text
                (again / name).write_text(text.replace(old, new))
    assert main([str(tmp_path / "runs"), f"out={tmp_path / 'out'}"]) == 0
    assert len(parsed) == 3  # of 24 configurations, which differ in 8 seeds
    assert len(compared) == 6  # one for each cell of the table, for all of its resamples
    with (tmp_path / "out" / "seeds.csv").open(newline="") as file:
        assert [row["seeds"] for row in csv.DictReader(file)] == ["8"] * 3


@pytest.mark.exhaustive
def test_report_five_hundred_runs_is_written_within_a_minute(tmp_path):
    """Report ten algorithms on ten tasks, five seeds of 1,000 episodes and 250 iterations each."""
    tasks = ["Venture", "Gravitar", "Pitfall", "Solaris", "PrivateEye", "MontezumaRevenge"]
    tasks += ["Climber", "Jumper", "Coinrun", "Caveflyer"]
    algorithms = ["ppo", "rnd", "icm", "sp", "snd_v", "snd_std", "snd_vic", "snd_vinv"]
    algorithms += ["snd_barlow", "snd_byol"]
    rng, steps = np.random.default_rng(0), np.linspace(500, 250 * 128, 1000).astype(int)
    for task, algo, seed in itertools.product(tasks, algorithms, range(5)):
        values = np.round(rng.random((2, 1000)), 3)
        episodes = {seed: list(zip(steps.tolist(), *values.tolist(), strict=True))}
        novelty = {seed: rng.random(250).round(3).tolist()}
        options = [f"env={task}", f"algo={algo}", f"seed={seed}"]
        made(tmp_path / "runs" / task / algo / str(seed), options, episodes, novelty)
    begun = time.monotonic()
    assert main([str(tmp_path / "runs"), f"out={tmp_path / 'out'}"]) == 0
    seconds = time.monotonic() - begun
    print(f"500 runs in {seconds:.0f} s")
    assert seconds < 60


def test_report_environment_name_with_slashes_stays_inside_out(runs, tmp_path):
    path = made(runs / "odd", ["env=gymnasium", "env.id=CartPole-v1", "algo=rnd"], {0: [(9, 1, 1)]})
    text = (path / "config.yaml").read_text()
    (path / "config.yaml").write_text(text.replace("name: CartPole-v1", "name: ../../$x{"))
    assert main([str(runs), f"out={tmp_path / 'out'}"]) == 0
    assert not [*tmp_path.glob("*.png"), *tmp_path.parent.glob("*.png")]
    assert list((tmp_path / "out").glob("*x*.png"))
