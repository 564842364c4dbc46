"""Stop runs by errors of the environment and by signals to every process of a run."""

import os
import re
import shlex
import signal
import subprocess
import sys
import time

import pytest
from helpers.processes import ROOT, check_nothing_lost, lines, tree_of

from experiments.config.compose import load_config
from experiments.run import main
from experiments.system import interrupts
from experiments.system.interrupts import Interrupts
from experiments.training import trainer

TASK = """
import os
from pathlib import Path

import gymnasium as gym
import numpy as np

here = Path(__file__).parent


class Task(gym.Env):
    observation_space = gym.spaces.Box(-1, 1, (3,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        self.age = 0
        if (here / "reset").exists():
            raise RuntimeError("no level")
        return np.zeros(3, np.float32), {}

    def step(self, action):
        self.age += 1
        look = np.full(3, 0.01 * self.age, np.float32)
        if self.age == 60:  # in the fourth iteration of sixteen steps
            for name, error in (("disk", OSError), ("number", FloatingPointError),
                                ("exit", SystemExit), ("value", ValueError)):
                if (here / name).exists():
                    raise error("of the task")
            if (here / "nan").exists():
                look[1] = np.nan
        return look, 0.0, self.age >= 100, False, {}


gym.register("Task-v0", Task)
"""
SMALL = ["num_envs=4", "rollout_length=16", "ppo.minibatch_size=32", "ppo.epochs=1"]
RUN = ["env=gymnasium", "env.id=stops_task:Task-v0", "algo=ppo", *SMALL]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "stops_task.py").write_text(TASK)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "stops_task", raising=False)
    yield tmp_path
    sys.modules.pop("stops_task", None)


def saved_iteration(path):
    """Return the iteration of the newest checkpoint, which can be read."""
    return tree_of(path, load_config([f"resume={path}", "env.id=stops_task:Task-v0"]))[0]


@pytest.mark.parametrize(
    ("switch", "named"),
    [
        ("disk", "OSError: of the task"),
        ("number", "FloatingPointError: of the task"),
        ("exit", "SystemExit: of the task"),
        ("value", "ValueError: of the task"),
    ],
)
def test_run_failing_environment_is_named_and_the_last_iteration_is_resumed(
    folder, capfd, switch, named
):
    (folder / switch).touch()
    assert main([*RUN, "total_steps=512", "run_dir=run"]) == 1
    err = capfd.readouterr().err
    place = re.escape(str(folder / "stops_task.py"))
    assert re.search(rf"Task-v0 failed: {named} \({place}, line \d+\)", err)
    assert "cannot write" not in err
    path = folder / "run"
    assert saved_iteration(path) == len(lines(path)) == 3  # checkpoint_every is 50
    (folder / switch).unlink()
    command = shlex.split(err.partition("to resume: ")[2])
    assert main(command[1:]) == 0
    check_nothing_lost(path, 8)


def test_run_environment_that_cannot_be_reset_leaves_nothing(folder, capfd):
    (folder / "reset").touch()
    assert main([*RUN, "total_steps=512", "run_dir=run"]) == 1
    assert "Task-v0 failed: RuntimeError: no level" in capfd.readouterr().err
    assert not (folder / "run").exists()


def test_run_error_after_an_update_leaves_no_checkpoint_of_another_iteration(
    folder, capfd, monkeypatch
):
    """Fail while the rewards of the third update are read, before it is in the log."""
    taken, real = [], trainer.nonfinite_terms

    def fails(*arguments):
        taken.append(1)
        if len(taken) == 3:
            raise MemoryError("of a test")
        return real(*arguments)

    monkeypatch.setattr(trainer, "nonfinite_terms", fails)
    assert main([*RUN, "total_steps=512", "run_dir=run"]) == 1
    err = capfd.readouterr().err
    assert "stopped by MemoryError: of a test" in err
    monkeypatch.undo()
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    command = shlex.split(err.partition("to resume: ")[2])
    assert main(command[1:]) == 0
    check_nothing_lost(folder / "run", 8)


def test_run_error_between_state_and_log_saves_no_state(folder, capfd, monkeypatch):
    """Fail before the third update is in the log: its state belongs to no logged iteration."""
    taken, real = [], trainer.RunLogger.log

    def fails(*arguments):
        taken.append(1)
        if len(taken) == 3:
            raise MemoryError("of a test")
        return real(*arguments)

    monkeypatch.setattr(trainer.RunLogger, "log", fails)
    assert main([*RUN, "total_steps=512", "run_dir=run"]) == 1
    assert "stopped by MemoryError" in capfd.readouterr().err
    assert saved_iteration(folder / "run") == 0  # the checkpoint before the first update


def test_run_observation_that_is_not_finite_is_named(folder, capfd, monkeypatch):
    (folder / "nan").touch()
    assert main([*RUN, "total_steps=512", "run_dir=run"]) == 1
    err = capfd.readouterr().err
    assert (
        "iteration 4, seed 0: the observation is nan (environment 0, step 12, component 1)" in err
    )
    assert "sndjax replay" in err


MODULE = """
import sndjax


def make(num_actions, size):
    module = sndjax.rnd(num_actions, size)

    def loss(*args):
        {body}

    return module._replace(loss=loss)
"""


@pytest.mark.parametrize(
    ("body", "named"),
    [
        ("raise SystemExit(5)", "stopped by SystemExit: 5"),
        ("open('/nonexistent/weights.npy')", "stopped by FileNotFoundError"),
    ],
)
def test_run_module_that_fails_is_named_and_leaves_a_checkpoint(folder, capfd, body, named):
    (folder / "mine.py").write_text(MODULE.format(body=body))
    options = [o for o in RUN if not o.startswith("algo=")] + ["algo=module"]
    options += ["algo.module=mine.py:make", "algo.minibatch_size=32"]
    assert main([*options, "total_steps=512", "run_dir=run"]) == 1
    err = capfd.readouterr().err
    assert named in err
    assert "cannot write" not in err
    assert 'mine.py", line' in err  # where
    assert re.search(r"to resume: \S+ resume=run algo.module=mine.py:make", err)
    assert any((folder / "run" / "checkpoints").iterdir())


def test_Interrupts_forked_process_has_default_handlers_and_may_start_a_session():
    with Interrupts():
        reader, writer = os.pipe()
        child = os.fork()
        if child == 0:
            kinds = [signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)]
            os.setsid()  # as a daemon does
            os.write(writer, b"1" if kinds == [signal.SIG_DFL] * 3 else b"0")
            os._exit(0)
        os.waitpid(child, 0)
        assert os.read(reader, 1) == b"1"
        os.close(reader)
        os.close(writer)
        # A simulator that an environment starts, in ways that run the hook in the child.
        for more in ({"preexec_fn": os.setsid}, {"preexec_fn": int, "start_new_session": True}):
            assert subprocess.run(["true"], check=False, **more).returncode == 0
    assert interrupts.active is None


def members(group):
    """Return the processes of a group."""
    listed = subprocess.run(["ps", "-eo", "pid=,pgid="], capture_output=True, text=True, check=True)
    pairs = [map(int, line.split()) for line in listed.stdout.splitlines()]
    return [pid for pid, own in pairs if own == group]


def descendants(pid):
    """Return the processes below a process."""
    listed = subprocess.run(["ps", "-eo", "pid=,ppid="], capture_output=True, text=True, check=True)
    parents = dict(map(int, line.split()) for line in listed.stdout.splitlines())
    found = {pid}
    while more := {p for p, parent in parents.items() if parent in found} - found:
        found |= more
    return found - {pid}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("to", ["group", "every process"])
def test_run_signal_to_all_processes_of_an_async_run_keeps_the_last_iteration(folder, number, to):
    """Ctrl-C in a terminal reaches the group; a scheduler signals every process of a job."""
    command = [sys.executable, "-m", "experiments.run", *RUN, "total_steps=100_000_000"]
    command += ["env.options.vectorization_mode=async", "run_dir=run"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(folder)])}
    with subprocess.Popen(
        command, cwd=folder, env=environment, text=True, stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL, start_new_session=True,
    ) as process:  # fmt: skip
        path, deadline = folder / "run", time.monotonic() + 120
        while not (path / "metrics.jsonl").exists() or len(lines(path)) < 4:
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < deadline
            time.sleep(0.05)
        workers = descendants(process.pid)
        assert len(workers) >= 4
        for pid in members(process.pid) if to == "group" else [*workers, process.pid]:
            os.kill(pid, number)
        _, err = process.communicate(timeout=60)
    assert process.returncode == 128 + number, err
    assert re.search(r"interrupted; to resume: \S+ resume=run env.id=stops_task:Task-v0", err)
    assert saved_iteration(path) == len(lines(path)) >= 4
    time.sleep(1)
    assert not [pid for pid in workers if os.path.exists(f"/proc/{pid}")]
