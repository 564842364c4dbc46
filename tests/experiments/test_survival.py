"""Kill, damage and resume runs, and fill their disk: check that nothing is lost.

`make test-survival` runs these tests in the numbers that docs/survival.md reports.
"""

import json
import os
import random
import shutil
import signal
import subprocess
import time
from contextlib import contextmanager

import numpy as np
import pytest
from helpers.processes import CAR, check_nothing_lost, lines, start, times, tree_of

from experiments.config.compose import load_config
from experiments.run import main


@contextmanager
def running(arguments, cwd, out=subprocess.DEVNULL):  # an unread pipe fills up
    """Start a run in a separate process, and kill it when the test ends."""
    with start(arguments, cwd, out) as process:
        try:
            yield process
        finally:
            process.kill()


survival = pytest.mark.survival


def prefix(path):
    """Return the lines of metrics.jsonl up to the newest checkpoint."""
    newest = max((int(p.name) for p in (path / "checkpoints").glob("[0-9]*")), default=0)
    return [e for e in whole_lines(path) if e["iteration"] <= newest]


def size_of(path):
    try:
        return (path / "metrics.jsonl").stat().st_size
    except FileNotFoundError:
        return 0


def whole_lines(path):
    try:
        text = (path / "metrics.jsonl").read_text()
    except FileNotFoundError:
        return []
    return [json.loads(line) for line in text.split("\n")[:-1]]


def stop(process, number):
    """Send a signal; check that the process ends within ten seconds; return its stderr."""
    process.send_signal(number)
    begun = time.monotonic()
    _, err = process.communicate(timeout=60)
    assert time.monotonic() - begun < 10
    assert "Traceback" not in err, err
    return err


def until(path, command, more, number=signal.SIGTERM):
    """Run until metrics.jsonl has `more` new lines, then stop the run."""
    wanted = len(whole_lines(path)) + more
    with running(command, path.parent) as process:
        while len(whole_lines(path)) < wanted:
            assert process.poll() is None, process.communicate()
            time.sleep(0.05)
        err = stop(process, number)
    assert process.returncode == 128 + number, err
    assert f"resume={path}" in err


@pytest.mark.parametrize("kills", [3, pytest.param(50, marks=survival)])
def test_run_killed_at_random_moments_loses_no_line(kills, tmp_path):
    path, draw = tmp_path / "run", random.Random(kills)
    command = [*CAR, "algo=rnd", "num_seeds=2", "checkpoint_every=3", "resume=auto"]
    command += ["total_steps=100_000_000", f"run_dir={path}"]
    kept, killed = [], 0
    while killed < kills:
        with running(command, tmp_path) as process:
            if killed % 3 == 0:
                time.sleep(draw.uniform(0, 8))  # mostly before the first iteration
            else:
                size = size_of(path)
                while size_of(path) == size:
                    assert process.poll() is None, process.communicate()
                    time.sleep(0.01)
                time.sleep(draw.uniform(0, 3))
            number = draw.choice([signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
            stop(process, number)
        # At the very start, Python's default handlers answer: ours are not installed yet.
        ours = 128 + number if number != signal.SIGKILL else -number
        assert process.returncode in ((ours, -number) if killed % 3 == 0 else (ours,))
        killed += 1
        now = prefix(path)
        assert now[: len(kept)] == kept  # lines before a checkpoint never change
        kept = now
    until(path, command, 20)
    print(f"{kills} kills, {len(lines(path))} lines, none lost")
    check_nothing_lost(path, len(lines(path)) // 2, seeds=2)
    assert lines(path)[: len(kept)] == kept


LONG = ["env=MountainCar", "algo=rnd", "num_envs=64", "rollout_length=512", "ppo.minibatch_size=64"]


def test_run_sigterm_during_a_long_update_stops_it(tmp_path):
    path = tmp_path / "run"
    command = [*LONG, "ppo.epochs=1000", "total_steps=100_000_000", f"run_dir={path}"]
    with running(command, tmp_path, out=subprocess.PIPE) as process:
        for line in process.stdout:
            if line.startswith("update compiled"):
                break
        time.sleep(1)
        err = stop(process, signal.SIGTERM)
    assert process.returncode == 143, err
    assert f"resume={path}" in err
    assert tree_of(path)[0] == len(lines(path)) == 0  # the checkpoint before the first update


def test_run_sigterm_after_an_older_checkpoint_keeps_the_state_before_the_update(tmp_path):
    """Stop the second update: the first regular checkpoint would be at the tenth iteration."""
    path = tmp_path / "run"
    command = [*LONG, "ppo.epochs=400", "total_steps=100_000_000", "checkpoint_every=10"]
    with running([*command, f"run_dir={path}"], tmp_path) as process:
        while len(whole_lines(path)) < 1:
            assert process.poll() is None, process.communicate()
            time.sleep(0.01)
        (line,) = times(path)
        assert line["update_seconds"] > 6, "too quick here to be broken off: take more epochs"
        time.sleep(line["collect_seconds"] + 1)
        err = stop(process, signal.SIGTERM)
    assert process.returncode == 143, err
    assert tree_of(path)[0] == len(lines(path)) == 1
    check_nothing_lost(path, 1)


def test_run_sigterm_at_the_start_ends_it(tmp_path):
    """Stop just after the title, while the weights are drawn and the policy is compiled."""
    path = tmp_path / "run"
    command = ["env=Venture", "algo=snd_std", "num_envs=8", f"run_dir={path}", "resume=auto"]
    with running(command, tmp_path, out=subprocess.PIPE) as process:
        assert "Venture snd_std" in process.stdout.readline()
        time.sleep(0.5)
        err = stop(process, signal.SIGTERM)
    assert process.returncode == 143, err


def test_run_closed_stdout_trains_to_the_end(tmp_path):
    path = tmp_path / "run"
    command = [*CAR, "algo=ppo", "total_steps=2560", f"run_dir={path}"]
    with running(command, tmp_path, out=subprocess.PIPE) as process:
        process.stdout.readline()
        process.stdout.close()
        process.stderr.read()
        assert process.wait(120) in (0, 1)
    assert len(lines(path)) == 20
    check_nothing_lost(path, 20)
    assert tree_of(path)[0] == 20


def test_run_resume_of_logs_without_checkpoint_is_refused(tmp_path, capfd):
    path = tmp_path / "run"
    assert main([*CAR, "algo=ppo", "total_steps=512", f"run_dir={path}"]) == 0
    before = (path / "metrics.jsonl").read_bytes()
    shutil.rmtree(path / "checkpoints")
    assert main([f"resume={path}"]) == 2
    assert "logs and no checkpoint" in capfd.readouterr().err
    assert (path / "metrics.jsonl").read_bytes() == before


def test_run_sigterm_leaves_a_checkpoint_that_can_be_extended(tmp_path):
    path = tmp_path / "run"
    until(path, [*CAR, "algo=rnd", "total_steps=100_000_000", f"run_dir={path}"], 7)
    iteration, _ = tree_of(path)
    assert iteration == len(lines(path)) >= 7
    check_nothing_lost(path, iteration)
    kept = lines(path)
    until(path, [f"resume={path}", "total_steps=200_000_000"], 3, signal.SIGINT)
    check_nothing_lost(path, len(lines(path)))
    assert lines(path)[:iteration] == kept
    assert load_config([f"resume={path}"]).total_steps == 200_000_000


def test_run_resume_damaged_checkpoint_uses_the_previous(tmp_path, capfd):
    path = tmp_path / "run"
    command = [*CAR, "algo=ppo", "total_steps=1024", "checkpoint_every=2", f"run_dir={path}"]
    assert main(command) == 0
    whole = lines(path)
    file = max((path / "checkpoints" / "8").rglob("*"), key=lambda p: p.stat().st_size)
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)
    assert main([f"resume={path}"]) == 0
    out = capfd.readouterr().out
    assert "checkpoint 8 cannot be used" in out
    assert "resuming from iteration 6" in out
    check_nothing_lost(path, 8)
    assert lines(path)[:6] == whole[:6]
    assert tree_of(path)[0] == 8  # complete again
    for step in (path / "checkpoints").iterdir():
        (step / "manifest.json").write_text("{}")
    before = (path / "metrics.jsonl").read_bytes()
    assert main([f"resume={path}"]) == 2
    assert "there is nothing to resume" in capfd.readouterr().err
    assert (path / "metrics.jsonl").read_bytes() == before


@pytest.fixture
def small_disk(tmp_path):
    """Mount a file system of three megabytes, and return its directory."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=3m", "none", str(place)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("may not mount a file system here")
    yield place
    subprocess.run(["umount", str(place)], check=True)


@pytest.mark.parametrize(
    "room", [300, *(pytest.param(room, marks=survival) for room in (900, 1500))]
)  # kB that are free when the run is resumed
def test_run_full_disk_keeps_the_last_complete_checkpoint(room, small_disk, tmp_path):
    path = small_disk / "run"
    command = [*CAR, "algo=rnd", "checkpoint_every=4", "total_steps=100_000_000", "resume=auto"]
    command += [f"run_dir={path}"]
    until(path, command, 9)
    assert tree_of(path)[0] >= 9
    used = sum(p.stat().st_size for p in path.rglob("*") if p.is_file())
    filler = small_disk / "filler"
    filler.write_bytes(bytes(max(2_900_000 - used - room * 1000, 0)))
    with running(command, tmp_path) as process:
        _, err = process.communicate(timeout=300)
    assert process.returncode == 1, err
    assert len(err.splitlines()) == 1
    assert "cannot write the run" in err
    assert f"resume={path}" in err
    stood, _ = tree_of(path)
    assert stood >= 9
    kept = [e for e in whole_lines(path) if e["iteration"] <= stood]
    filler.unlink()
    until(path, command, 6)
    check_nothing_lost(path, len(lines(path)))
    assert lines(path)[:stood] == kept


@survival
def test_run_half_an_hour_keeps_memory_files_and_speed(tmp_path):
    """Check that memory grows by less than 2%, files are closed, and the speed is constant."""
    path, seconds = tmp_path / "run", 1800
    command = ["env=MountainCar", "algo=snd_vic", "total_steps=10_000_000_000", f"run_dir={path}"]
    with running(command, tmp_path) as process:
        begun, files = time.monotonic(), []
        while time.monotonic() - begun < seconds:
            time.sleep(10)
            assert process.poll() is None
            files.append(len(os.listdir(f"/proc/{process.pid}/fd")))
        process.send_signal(signal.SIGTERM)
        process.wait(60)
    entries = lines(path)
    warm = [e for e in times(path) if e["wall_seconds"] > 120]
    memory = [e["rss_mb"] for e in warm]
    third = len(warm) // 3
    rate = [
        np.median([e["steps_per_second"] for e in part]) for part in (warm[:third], warm[-third:])
    ]
    print(
        f"{len(entries)} iterations, {entries[-1]['step']} steps, memory {min(memory):.0f} to "
        f"{max(memory):.0f} MB, files {min(files[6:])} to {max(files[6:])}, median rate of the "
        f"first third {rate[0]:.0f}, of the last {rate[1]:.0f} steps/s"
    )
    check_nothing_lost(path, len(entries))
    assert max(memory) < 1.02 * min(memory)
    assert max(files[6:]) - min(files[6:]) <= 2  # the files of a checkpoint that is being written
    assert rate[1] > 0.9 * rate[0]
