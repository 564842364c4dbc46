"""Paste the command lines that are printed into a real shell, with names that need quotes.

The run directory's name holds a space, an equals sign and a comma; the task and the module are the
user's own.
"""

import os
import re
import shutil
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest
from helpers.processes import CAR, ROOT, lines

from experiments import cli, demo, evaluate
from experiments.config.command_text import (
    command_text,
    option_text,
    path_text,
    replay_command,
    shell_text,
)
from experiments.config.compose import load_config
from experiments.config.saved import read_saved
from experiments.run import main
from experiments.storage import checkpoints
from experiments.sweeps import multirun
from experiments.system.interrupts import Interrupted
from experiments.training import trainer

ODD = "my run/a=b, c"
MODULE = "my code/bonus=1, v2.py"
SMALL = ["num_envs=2", "rollout_length=32", "ppo.minibatch_size=64", "ppo.epochs=1"]
OWN = [
    "env=gymnasium",
    "env.id=my_task:Corridor-v0",
    option_text("algo.module", f"{MODULE}:my_bonus"),
]
OWN += [*SMALL, "algo.minibatch_size=64", "total_steps=64"]


def paste(line, cwd):
    """Run a command line in bash; return its exit status and what it prints."""
    done = subprocess.run(
        ["bash", "-c", line],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=300,
    )
    return done.returncode, done.stdout


def after(words, text):
    """Return the rest of the only line that holds these words."""
    (line,) = [line for line in text.splitlines() if words in line]
    return line.partition(words)[2].strip()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Make the user's folder, with a task, a module and a run of both."""
    path = tmp_path_factory.mktemp("user")
    (path / MODULE).parent.mkdir()
    shutil.copy(ROOT / "examples" / "my_bonus.py", path / MODULE)
    shutil.copy(ROOT / "examples" / "own_environment.py", path / "my_task.py")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(path)
        patch.setattr(sys, "path", [*sys.path])
        assert main([*OWN, option_text("run_dir", ODD)]) == 0
    return path


@pytest.fixture
def trained(folder, tmp_path, monkeypatch):
    """Go to a copy of the user's folder, and return its run."""
    shutil.copytree(folder, tmp_path / "user")
    monkeypatch.chdir(tmp_path / "user")
    monkeypatch.setattr(sys, "path", [*sys.path])
    return Path(ODD)


@pytest.fixture
def own(trained):
    """Go to a copy of the user's folder, without its run."""
    shutil.rmtree(trained)
    return Path.cwd()


def interrupted(real):
    """Let the training be interrupted by a signal after its last iteration."""

    def train(*given):
        real(*given)
        raise Interrupted(signal.SIGINT)

    return train


def test_run_hint_after_a_signal_resumes_the_run_when_pasted(own, capfd, monkeypatch):
    monkeypatch.setattr(trainer, "train", interrupted(trainer.train))
    assert main([*OWN, option_text("run_dir", ODD)]) == 130
    line = after("to resume: ", capfd.readouterr().err)
    status, out = paste(f"{line} total_steps=128", own)
    assert status == 0, out
    assert [entry["step"] for entry in lines(own / ODD)] == [64, 128]


def test_run_hint_after_a_full_disk_resumes_the_run_when_pasted(own, capfd, monkeypatch):
    def full(*given):
        raise OSError("No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(checkpoints, "write_tree", full)
        assert main([*OWN, option_text("run_dir", ODD)]) == 1
    line = after("to resume: ", capfd.readouterr().err)
    status, out = paste(line, own)
    assert status == 0 or "there is nothing to resume" in out, out


def test_run_directory_that_is_not_empty_is_resumed_when_pasted(trained, capfd):
    assert main([*CAR, "algo=ppo", option_text("run_dir", ODD)]) == 2
    line = after("to resume the run in it: ", capfd.readouterr().err)
    status, out = paste(line, Path.cwd())
    assert status == 0, out
    other = Path("other")
    other.mkdir()
    (other / "mine").touch()
    assert main([*CAR, "algo=ppo", "run_dir=other"]) == 2
    assert capfd.readouterr().err.endswith("is not empty; give another run_dir\n")


@pytest.mark.parametrize("command", ["resume", "repeat", "evaluate", "record", "analyze"])
def test_command_refused_for_safety_works_with_what_it_asks_for(command, trained, capfd):
    path = path_text(trained)
    words = {
        "resume": [option_text("resume", path)],
        "repeat": [option_text("repeat", f"{path}/config.yaml"), "run_dir=again"],
        "evaluate": ["evaluate", path, "episodes=2"],
        "record": ["record", path, "episodes=1"],
        "analyze": ["analyze", path, "states=100"],
    }[command]
    asked = refused_for_safety(words, capfd)
    status, out = paste(f"{command_text(*words)} {asked}", Path.cwd())
    if command == "record":  # the code was trusted; a vector has no images
        assert "only those with images can be drawn" in out
    else:
        assert status == 0, out


def refused_for_safety(words, capfd):
    """Return what a command asks to be repeated."""
    capfd.readouterr()
    assert cli.main(words) == 2
    err = capfd.readouterr().err
    assert "this run uses a custom module and has a task in a Python module" in err
    return re.search(r"for safety repeat (.*) on the command line, if you trust it", err).group(1)


def test_replay_command_of_a_dump_repeats_the_update_when_pasted(own, capfd):
    assert main([*OWN, option_text("run_dir", ODD), "ppo.value_weight=3e38"]) == 1
    run = (own / ODD).relative_to(own)
    config = read_saved(run / "config.yaml").config
    status, out = paste(replay_command(run / "wrong-1", config), own)
    assert status == 0, out
    assert "after the update, seed 0:" in out
    words = ["replay", path_text(run / "wrong-1")]
    asked = refused_for_safety(words, capfd)
    assert replay_command(run / "wrong-1", config) == f"{command_text(*words)} {asked}"


def test_evaluate_path_that_looks_like_an_option_is_taken_as_a_path(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    assert main([*CAR, "algo=ppo", "total_steps=128", 'run_dir="a=b"']) == 0
    for path in ("a=b", path_text(Path("a=b"))):
        assert evaluate.main([path, "episodes=1"]) == 0, capfd.readouterr().err
    assert evaluate.main(["b=a", "episodes=1"]) == 2
    assert "unknown option 'b'" in capfd.readouterr().err


def test_sweep_hint_after_a_signal_ends_the_sweep_when_pasted(own, capfd, monkeypatch):
    def launch(runner, arguments):
        os.kill(os.getpid(), signal.SIGINT)
        return ""

    monkeypatch.setattr(multirun, "launch", launch)
    task = "env.id=my_task:Corridor-v0"
    module = option_text("algo.module", f"{MODULE}:my_bonus")
    given = ["-m", "env=gymnasium", task, module, *OWN[3:], "seed=0,1"]
    assert main([*given, option_text("hydra.sweep.dir", "my sweeps/a=b, c")]) == 130
    line = after("to resume, give the same command: ", capfd.readouterr().out)
    status, out = paste(line, own)
    assert status == 0, out
    assert "2 jobs: 2 done" in out
    assert len([*(own / "my sweeps/a=b, c").rglob("metrics.jsonl")]) == 2


def test_run_refused_path_is_written_as_the_message_says(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    line = f"{command_text(*CAR, 'algo=ppo', 'total_steps=128')} {shell_text(f'run_dir={ODD}')}"
    status, out = paste(line, tmp_path)
    assert status == 2, out
    instead = re.search(r"in a shell write ('.*')", out).group(1)
    line = f"{command_text(*CAR, 'algo=ppo', 'total_steps=128')} {instead}"
    status, out = paste(line, tmp_path)
    assert status == 0, out
    assert len(lines(tmp_path / ODD)) == 1


def test_demo_printed_commands_are_read_as_they_were_run(tmp_path, monkeypatch, capsys):
    ran = []

    def keep(*arguments):
        ran.append([*arguments])
        return subprocess.CompletedProcess(arguments, 0)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(demo, "run_command_line", keep)
    with suppress(Exception):  # there is no run whose curve could be drawn
        demo.main(["seeds=1", "steps=1e3"])
    printed = [line[2:] for line in capsys.readouterr().out.splitlines() if line.startswith("$ ")]
    assert [["run", *line.split()[1:]] for line in printed] == ran
    assert len(ran) == 2
    for line in printed:
        load_config(line.split()[1:])
