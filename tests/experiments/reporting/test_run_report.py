import csv
import json
import re
import shutil
import subprocess

import numpy as np
import pytest
from helpers.run_files import made

from experiments.report import main
from experiments.reporting.learning_curves import QUANTITIES, draw_curves
from experiments.reporting.thesis_tables import improvement_table, seeds_table, thesis_table
from experiments.storage.read_runs import find_runs, group_runs

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
    # Step 100 is the only common step: the second seed ends there with 1, the first still has 0.
    assert {(row["step"], row["mean"]) for row in rows} == {("100.0", "0.5")}


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


def test_longest_run_per_seed_repeated_seed_is_counted_once(runs):
    made(runs / "again", ["env=Venture", "algo=snd_vic"], {0: [(9, 9.0, 9.0)]}, {0: [0.5]})
    made(runs / "without", ["env=Venture", "algo=snd_vic", "seed=7"], {7: []}, {7: [0.5]})
    mine = rows_of(thesis_table("5.6", group_runs(find_runs([runs])[0])))
    assert mine["Venture", "SND-VIC"][:3] == ["1.50 ± 0.50", "2", "0.000128 to 0.000256"]


def test_report_environment_name_with_slashes_stays_inside_out(runs, tmp_path):
    path = made(runs / "odd", ["env=gymnasium", "env.id=CartPole-v1", "algo=rnd"], {0: [(9, 1, 1)]})
    text = (path / "config.yaml").read_text()
    (path / "config.yaml").write_text(text.replace("name: CartPole-v1", "name: ../../$x{"))
    assert main([str(runs), f"out={tmp_path / 'out'}"]) == 0
    assert not [*tmp_path.glob("*.png"), *tmp_path.parent.glob("*.png")]
    assert list((tmp_path / "out").glob("*x*.png"))
