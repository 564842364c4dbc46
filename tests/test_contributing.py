"""CONTRIBUTING.md's walks, done on a copy of the tree, and the tables of README.md."""

import os
import re
import shutil
import subprocess
import sys
from textwrap import dedent

import jax
import jax.numpy as jnp
import pytest
from helpers.processes import CAR, ROOT

import sndjax
from sndjax.algorithm_table import ALGORITHMS
from sndjax.bonus_record import PRESETS
from sndjax.grid import OBJECTIVES, SIGNALS


@pytest.fixture(scope="module")
def walked(tmp_path_factory):
    """A copy of both trees with the objective and the command of the walks."""
    copy = tmp_path_factory.mktemp("copy")
    for name in ("sndjax", "experiments"):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    text = (ROOT / "CONTRIBUTING.md").read_text()
    slow, squares, longest = (
        dedent("   " + code) for code in re.findall(r"```python\n   (.*?)```", text, re.DOTALL)
    )
    for package, name, code in (("objectives", "slow", slow), ("signals", "squares", squares)):
        (copy / "sndjax" / package / f"{name}.py").write_text(code)
        with (copy / "sndjax" / package / "__init__.py").open("a") as file:
            file.write(re.search(rf"`(from sndjax.{package}.{name} [^`]*)`", text)[1] + "\n")
    (copy / "experiments" / "longest.py").write_text(longest)
    table = copy / "experiments" / "cli.py"
    line = 'COMMANDS = {\n    "longest": "print the longest training episode of a run",\n'
    table.write_text(table.read_text().replace("COMMANDS = {\n", line))
    return copy


def call(walked, *arguments):
    """Run the command of the copy."""
    done = subprocess.run(
        [sys.executable, "-m", "experiments.cli", *arguments], cwd=walked, text=True,
        env=os.environ | {"PYTHONPATH": str(walked)}, capture_output=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_walks_of_contributing_give_objective_signal_and_command_that_run(walked):
    cell = ["algo=grid", "algo.objective=slow", "algo.signal=squares"]
    run = [*CAR, *cell, "algo.minibatch_size=64", "total_steps=2048", "run_dir=one"]
    assert "finished: one" in call(walked, *run)
    assert "slow_distance" in (walked / "one" / "metrics.jsonl").read_text()
    bench = call(walked, "bench", *CAR, *cell, "algo.minibatch_size=64", "total_steps=2048")
    assert '"nominal_gflop_per_step": null' in bench  # its operations were not derived
    assert "first=0" in call(walked, "longest", "--help")
    assert call(walked, "longest", "one") == "seed 0: 200 steps\n"  # MountainCar's limit


def test_map_of_contributing_names_every_room():
    text = (ROOT / "CONTRIBUTING.md").read_text()
    for path in (ROOT / "experiments").iterdir():
        if (path / "__init__.py").is_file():
            assert f"      {path.name}/" in text


def test_table_of_readme_has_every_algorithm_with_its_objective_and_signal():
    readme = (ROOT / "README.md").read_text()
    rows = [line for line in readme.splitlines() if line.startswith("| `")]
    pages = {"none": "", "distillation": "distillation", "prediction": "forward prediction"}
    titles = {
        "contrastive": "contrastive pairs", "st_dim": "ST-DIM", "vicreg": "VICReg",
        "vicreg_inverse": "VICReg and inverse dynamics", "barlow_twins": "Barlow Twins",
        "byol": "BYOL", "inverse_dynamics": "inverse dynamics", "none": "none",
    }  # fmt: skip
    for name, row in ALGORITHMS.items():
        (line,) = [text for text in rows if f"`{name}`" in text.split("|")[1]]
        if row.objective is None:
            continue
        _, _, objective, signal, *_ = line.split("|")
        assert titles[row.objective] in objective
        assert pages[row.signal] in signal


def test_readme_is_short_and_its_links_and_those_of_the_docs_exist():
    assert len((ROOT / "README.md").read_text().splitlines()) < 150
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]
    for page in pages:
        for link in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text()):
            assert link.startswith("http") or (page.parent / link).exists(), f"{page}: {link}"


@pytest.mark.parametrize("kind", ["objectives", "signals"])
def test_every_objective_and_signal_has_its_page_and_its_rows(kind):
    names = set(OBJECTIVES if kind == "objectives" else SIGNALS)
    pages = {path.stem for path in (ROOT / "docs" / kind).glob("*.md")}
    assert pages == names
    grid = (ROOT / "docs" / "grid.md").read_text()
    nav = (ROOT / "mkdocs.yml").read_text()
    layout = (ROOT / "docs" / "layout.md").read_text()
    for name in names:
        assert f"[{name}]({kind}/{name}.md)" in grid
        assert f"- {name}: {kind}/{name}.md" in nav
        assert "**Cost.**" in (ROOT / "docs" / kind / f"{name}.md").read_text()
        assert kind == "objectives" or f"`{name}`" in layout


def test_code_of_the_page_on_extending_makes_a_bonus():
    text = (ROOT / "docs" / "extend.md").read_text()
    _, objective, signal = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    space = {}
    exec(objective, space)
    exec(signal, space)
    obs = jnp.ones((4, 3)) * jnp.arange(4.0)[:, None]
    module = sndjax.make_module(space["slow"], space["surprise_ratio"], 2, sndjax.VECTOR)
    own = sndjax.bonus(module, num_actions=2, example=obs)
    state, no = own.init(jax.random.key(0), obs), jnp.zeros((1, 4), bool)
    reward, state, metrics = own.step(state, obs[None], no.astype(int), obs[None] + 1, no)
    assert (reward > 0).all()
    assert metrics["slow_loss"] > 0
    made = sndjax.make_module(space["slow"](2.0), "noveld", 2, sndjax.VECTOR)
    assert "slow(weight=2.0), signal=noveld" in repr(made)


def test_settings_of_the_manual_are_those_of_the_presets():
    text = (ROOT / "docs" / "settings.md").read_text()
    rows = dict(re.findall(r"^\| `(\w+)` \| (.*)$", text, re.MULTILINE))
    for field in sndjax.BonusSettings._fields:
        thesis, small = (cell.strip(" `") for cell in rows[field].split("|")[:2])
        for shown, preset in ((thesis, "thesis"), (small, "small")):
            value = getattr(PRESETS[preset], field)
            if field != "standardize":  # that follows from the observations
                assert shown == str(value) or float(shown) == value, (field, preset)
