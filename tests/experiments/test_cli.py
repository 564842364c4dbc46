"""Every command of the table: its help without side effects, its refusal in one line."""

import ast
import os
import subprocess
import sys
from dataclasses import fields
from importlib import import_module

import pytest
from helpers.processes import ROOT

from experiments.cli import ALIASES, COMMANDS, help_text, main, split_command

ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT)}


def call(arguments, cwd):
    """Run a module of the laboratory in a directory; the finished process."""
    command = [sys.executable, "-m", *arguments]
    return subprocess.run(
        command, cwd=cwd, env=ENVIRONMENT, capture_output=True, text=True, timeout=60
    )


def test_COMMANDS_files_of_the_folder_are_all_in_the_table():
    files = {path.stem for path in (ROOT / "experiments").glob("*.py")} - {"__init__", "cli"}
    assert files == {*COMMANDS, *ALIASES}
    assert set(ALIASES.values()) <= set(COMMANDS)
    for name, about in COMMANDS.items():
        assert f"  {name} " in help_text()
        assert about in help_text()


@pytest.mark.parametrize("name", [*COMMANDS, *ALIASES])
def test_main_help_shows_every_option_in_two_seconds_and_starts_nothing(name, tmp_path):
    before = os.times()
    done = call([f"experiments.{name}", "--help"], tmp_path)
    after = os.times()
    # Processor time: the other tests' work beside this one does not count.
    used = after.children_user + after.children_system
    assert used - before.children_user - before.children_system < 2
    assert (done.returncode, done.stderr) == (0, "")
    assert list(tmp_path.iterdir()) == []
    module = import_module(f"experiments.{ALIASES.get(name, name)}")
    for option in fields(module.Options) if hasattr(module, "Options") else ():
        (line,) = [x for x in done.stdout.splitlines() if x.startswith(f"  {option.name}=")]
        assert option.metadata["about"] in line
    through_table = call(["experiments.cli", name, "--help"], tmp_path)
    assert (through_table.returncode, through_table.stdout) == (0, done.stdout)


def test_tool_help_ranges_and_defaults_are_shown(tmp_path):
    shown = call(["experiments.evaluate", "--help"], tmp_path).stdout
    assert "  episodes=16                that each seed plays, side by side [1 to 1024]" in shown
    shown = call(["experiments.bench", "--help"], tmp_path).stdout
    assert "ppo.epochs=4" in shown  # it takes the options of a run
    assert "[more than 0, at most 1]" in shown


@pytest.mark.parametrize("name", COMMANDS)
def test_main_unknown_option_is_one_line_and_status_2(name, tmp_path):
    done = call([f"experiments.{name}", "nothing=1"], tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith("sndjax: ")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "arguments",
    [
        ["report", "nosuch"], ["external", "nosuch.py"], ["gpu_suite", "--envs", "zzz", "--cpu"],
        ["replay", "nosuch"], ["sweep", "status", "nosuch"], ["evaluate", "nosuch"],
        ["bench", "env=Venture", "--peak", "2"], ["bench_suite", "nosuch"],
    ],
    ids=" ".join,
)  # fmt: skip
def test_main_missing_file_or_wrong_name_is_one_line_and_leaves_nothing(arguments, tmp_path):
    done = call(["experiments.cli", *arguments], tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith("sndjax: ")
    assert "Errno" not in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_subprocesses_starters_in_the_laboratory_are_in_one_file():
    starters = {
        path.name
        for path in (ROOT / "experiments").rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and ast.unparse(node.func) in ("subprocess.run", "subprocess.Popen", "os.system")
    }
    assert starters == {"subprocesses.py", "versions.py"}  # versions.py asks git


def test_main_help_imports_no_jax():
    code = "import sys; from experiments.cli import main; assert main(sys.argv[1:]) == 0\n"
    code += "assert not {'jax', 'envpool', 'flax', 'sndjax'} & set(sys.modules), 'imported'"
    for name in COMMANDS:
        done = subprocess.run(
            [sys.executable, "-c", code, name, "--help"],
            env=ENVIRONMENT, capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 0, f"{name}: {done.stderr}"


def test_split_command_run_alias_and_dashed_name_are_recognised():
    assert split_command(["env=Venture"]) == ("run", ["env=Venture"])
    assert split_command(["-m", "seed=0,1"]) == ("run", ["-m", "seed=0,1"])
    assert split_command(["seed-table", "runs"]) == ("seed_table", ["runs"])
    assert split_command(["explores", "runs"]) == ("seed_table", ["runs"])


def test_main_unknown_command_names_the_nearest(capsys):
    assert main(["repot", "runs/"]) == 2
    assert "unknown command 'repot'; did you mean report" in capsys.readouterr().err
    assert main([]) == 2
    assert "usage: sndjax" in capsys.readouterr().out
