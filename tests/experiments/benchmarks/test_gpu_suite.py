"""Test `gpu_suite` on a CPU, with tasks of seconds."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest
from helpers.processes import ROOT

from experiments.benchmarks import gpu_page, gpu_suite
from experiments.benchmarks.gpu_numbers import relative_difference
from experiments.benchmarks.gpu_steps import STEPS
from experiments.gpu_suite import main

MINUTE = ["minutes=1", "cpu=true", "envs=MountainCar", "algos=sp_vinv", "at_once=1"]


def test_gpu_suite_without_gpu_runs_nothing_and_prints_reason(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(gpu_suite, "jax_backend", lambda: "cpu")
    assert main(["--out", str(tmp_path / "out")]) == 2
    assert "jax sees no GPU here: not run" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_gpu_suite_a_minute_on_a_cpu_measures_trains_and_writes_the_page(tmp_path, capsys):
    out, runs = tmp_path / "out", tmp_path / "my runs, a=1"  # a name that Hydra reads in quotes
    places = [f"out={out}", f"runs={runs}"]
    begun = time.monotonic()
    assert main([*MINUTE, *places, "steps=pool,module_beside,overlap"]) == 0
    assert time.monotonic() - begun < 120
    page = (out / "suite.md").read_text()
    assert "small tasks on a CPU" in page
    rate = {name: json.loads((out / f"{name}.jsonl").read_text()) for name in ("pool", "overlap")}
    assert rate["overlap"]["small"]
    assert rate["overlap"]["options"].endswith("overlap=1")
    share = rate["overlap"]["steps_per_second"] / rate["pool"]["steps_per_second"]
    row = next(line for line in page.splitlines() if line.startswith("| overlap=1 |"))
    assert f"| {rate['overlap']['steps_per_second']:,.0f} | {share:.2f} |" in row
    assert "| overlap=1, 512 environments | not run |" in page
    rows = gpu_page.read_rows(out / "run-MountainCar-sp_vinv.jsonl")
    assert rows[-1]["steps_per_second"] > 0
    assert f"| MountainCar sp_vinv | {rows[-1]['step']:,} |" in page
    assert (runs / "report" / "index.html").is_file()


def test_Suite_measure_what_takes_too_long_is_stopped_and_its_rows_stay(tmp_path, monkeypatch):
    stand_in = tmp_path / "slow"
    stand_in.write_text('#!/bin/sh\necho \'{"case": "first"}\'\nexec sleep 60\n')
    stand_in.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(stand_in))
    suite = gpu_suite.Suite(tmp_path, tmp_path, 1, cpu=True)
    begun = time.monotonic()
    assert suite.measure("numbers", 2) == "1 row(s), stopped after 2 s"
    assert time.monotonic() - begun < 20
    assert gpu_page.read_rows(tmp_path / "numbers.jsonl") == [{"case": "first"}]


def test_Suite_measure_that_fails_keeps_the_earlier_file_and_says_why(tmp_path, monkeypatch):
    stand_in = tmp_path / "broken"
    stand_in.write_text("#!/bin/sh\necho out of memory >&2\nexit 1\n")
    stand_in.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(stand_in))
    (tmp_path / "overlap.jsonl").write_text('{"steps_per_second": 5}\n')
    suite = gpu_suite.Suite(tmp_path, tmp_path, 1, cpu=True)
    assert suite.measure("overlap", 20) == "0 row(s), failed: out of memory"
    assert gpu_page.read_rows(tmp_path / "overlap.jsonl") == [{"steps_per_second": 5}]


def test_print_measurement_numbers_differ_from_float32_as_their_bits_say(capsys):
    gpu_suite.print_measurement("numbers")
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(rows) == 3
    first = rows[0]
    assert first["default"] == first["float32"] == 0  # the same device
    assert 0 < first["tf32"] < first["bf16"] < 0.05


def test_write_page_goal_is_a_share_of_random_actions(tmp_path):
    where = {"device": "GPU", "cores": 16, "versions": {}, "small": False}
    for name, rate in (("pool", 20_000.0), ("overlap", 15_000.0), ("module_beside", 9_000.0)):
        row = {"steps_per_second": rate} | where
        (tmp_path / f"{name}.jsonl").write_text(json.dumps(row) + "\n" + '{"cut off')
    gpu_page.write_page(tmp_path, "the command")
    page = (tmp_path / "suite.md").read_text()
    assert "| overlap=1 | 15,000 | 0.75 | 2.4 |" in page
    assert "with overlap=1: met." in page
    assert "small tasks" not in page


def test_write_page_rows_of_another_device_are_left_out(tmp_path):
    gpu = {"device": "GPU", "cores": 16, "versions": {}, "small": False}
    for name, where in (("overlap", gpu | {"small": True, "device": "CPU"}), ("pool", gpu)):
        row = json.dumps({"steps_per_second": 1000.0} | where)
        (tmp_path / f"{name}.jsonl").write_text(row + "\n")
        os.utime(tmp_path / f"{name}.jsonl", (1, 1 + (name == "pool")))
    gpu_page.write_page(tmp_path, "the command")
    page = (tmp_path / "suite.md").read_text()
    assert "| overlap=1 | not run |" in page
    assert "Device: GPU" in page
    assert "met." not in page


def test_number_table_a_case_that_failed_first_leaves_the_others():
    rows = [{"case": "a", "error": "no memory"}, {"case": "b", "default": 0.5, "cores": 2}]
    head, _, first, second = gpu_page.number_table(rows)
    assert head.endswith("| default |")
    assert first == "| a (failed: no memory) |  |"
    assert second == "| b | 5.0e-01 |"


def test_relative_difference_what_is_not_finite_is_infinitely_far():
    one = {"a": 1.0, "b": 2.0}
    assert relative_difference({"a": 1.0, "b": 2.2}, one) == pytest.approx(0.1)
    for other in ({"a": 1.0, "b": float("nan")}, {"a": float("inf"), "b": 2.0}):
        assert relative_difference(other, one) == float("inf")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_Suite_run_cut_off_keeps_every_row_that_came(number, tmp_path):
    code = (
        "import signal, sys; from pathlib import Path\n"
        # A shell's background job ignores it, and so would this process.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from experiments.benchmarks.gpu_suite import Suite\n"
        "sys.executable = sys.argv[1]\n"
        "Suite(Path(sys.argv[2]), Path('runs'), 9, cpu=True).run('numbers', [], 1)\n"
    )
    row = {"case": "first", "default": 0.5, "device": "CPU", "cores": 2, "versions": {}}
    stand_in, out = tmp_path / "slow", tmp_path / "out"
    text = json.dumps(row | {"small": True})
    stand_in.write_text(f"#!/bin/sh\necho '{text}'\nexec sleep 60\n")
    stand_in.chmod(0o755)
    with subprocess.Popen(
        [sys.executable, "-c", code, str(stand_in), str(out)],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stderr=subprocess.PIPE,
    ) as process:
        while not gpu_page.read_rows(out / "numbers.jsonl"):
            assert process.poll() is None, process.communicate()
            time.sleep(0.05)
        process.send_signal(number)
        process.communicate(timeout=30)
    assert process.returncode != 0
    assert gpu_page.read_rows(out / "numbers.jsonl") == [row | {"small": True}]
    assert "| first | 5.0e-01 |" in (out / "suite.md").read_text()


def test_gpu_suite_unknown_measurement_is_refused(tmp_path, capsys):
    assert main([*MINUTE, f"out={tmp_path / 'out'}", "steps=overlop"]) == 2
    assert "did you mean overlap" in capsys.readouterr().err
    assert len({step.name for step in STEPS}) == len(STEPS)


RUN = """#!/bin/sh
echo "begin $5 $6" >> {times}
trap 'echo "end $5 $6" >> {times}; exit 143' TERM
case "$*" in *algo=broken*) exit 1;; esac
echo "says $6, all of the memory: $XLA_PYTHON_CLIENT_PREALLOCATE"
sleep 60 & wait
"""


def test_train_together_side_by_side_runs_start_at_once_and_write_to_files(tmp_path, monkeypatch):
    times, stand_in = tmp_path / "times", tmp_path / "run"
    stand_in.write_text(RUN.format(times=times))
    stand_in.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(stand_in))
    monkeypatch.delenv("XLA_PYTHON_CLIENT_PREALLOCATE", raising=False)
    cells = [("Venture", "ppo"), ("Venture", "broken"), ("Venture", "rnd")]
    assert gpu_suite.train_together(cells, tmp_path, 2.0, alone=False) == [0, 1, 0]
    events = times.read_text().splitlines()
    assert sorted(events[:3]) == [f"begin env=Venture algo={a}" for a in ("broken", "ppo", "rnd")]
    assert sorted(events[3:]) == [f"end env=Venture algo={a}" for a in ("ppo", "rnd")]
    said = (tmp_path / "Venture" / "rnd.log").read_text()
    assert said == "says algo=rnd, all of the memory: false\n"


def test_Suite_train_rounds_share_the_time_and_a_failed_run_is_named(tmp_path, monkeypatch):
    asked = []

    def train(pairs, out, seconds, alone, patience, meanwhile):
        assert patience <= 30
        meanwhile()
        asked.append(([algo for _, algo in pairs], round(seconds), alone))
        return [int(algo == "rnd") for _, algo in pairs]

    monkeypatch.setattr(gpu_suite, "train_together", train)
    monkeypatch.setattr(gpu_suite, "write_report", lambda *_, **__: None)
    pairs = [("Venture", algo) for algo in ("ppo", "rnd", "icm")]
    suite = gpu_suite.Suite(tmp_path / "out", tmp_path / "runs", 4, cpu=True)
    suite.out.mkdir()
    with pytest.raises(Exception, match="these runs failed: Venture rnd \\(status 1\\)"):
        suite.train(pairs, 2)
    assert asked == [(["ppo", "rnd"], 96, False), (["icm"], 96, False)]  # 24 s to stop
    asked.clear()
    gpu_suite.Suite(tmp_path / "out", tmp_path / "runs", 1, cpu=True).train(
        pairs[:1] + pairs[2:], 1
    )
    assert asked == [(["ppo"], 54, True)]  # a minute is too short for two rounds
