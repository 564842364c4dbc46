"""Test `gpu_suite` on a CPU, with tasks of seconds."""

import json
import sys

from experiments.benchmarks import gpu_suite as evidence
from experiments.gpu_suite import main


def test_gpu_suite_without_gpu_runs_nothing_and_prints_reason(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(evidence, "jax_backend", lambda: "cpu")
    assert main(["--out", str(tmp_path / "out")]) == 2
    assert "jax sees no GPU here: not run" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_gpu_suite_runs_stop_at_their_share_and_resume_when_called_again(tmp_path):
    def steps_after(out, minutes):
        arguments = ["--minutes", minutes, "--envs", "MountainCar", "--algos", "sp_vinv"]
        assert main(["--cpu", *arguments, "--out", str(out)]) == 0
        run = out / "MountainCar" / "sp_vinv"
        assert list((run / "checkpoints").iterdir())
        assert (out / "report" / "index.html").is_file()
        return json.loads((run / "metrics.jsonl").read_text().splitlines()[-1])["step"]

    whole = 1_003_520
    for minutes in ("0.4", "0.25", "0.15"):  # a fast machine may complete the run
        out = tmp_path / f"my runs, a={minutes}"  # a name that Hydra reads only in quotes
        first = steps_after(out, minutes)
        if first < whole:
            break
    assert 0 < first < steps_after(out, minutes) <= whole


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
    assert evidence.train_together(cells, tmp_path, 2.0, alone=False) == [0, 1, 0]
    events = times.read_text().splitlines()
    assert sorted(events[:3]) == [f"begin env=Venture algo={a}" for a in ("broken", "ppo", "rnd")]
    assert sorted(events[3:]) == [f"end env=Venture algo={a}" for a in ("ppo", "rnd")]
    said = (tmp_path / "Venture" / "rnd.log").read_text()
    assert said == "says algo=rnd, all of the memory: false\n"


def test_run_suite_rounds_share_the_minutes_and_a_failed_run_is_named(
    tmp_path, monkeypatch, capsys
):
    asked = []

    def train(cells, out, seconds, alone):
        asked.append(([algo for _, algo in cells], seconds, alone))
        return [int(algo == "rnd") for _, algo in cells]

    monkeypatch.setattr(evidence, "train_together", train)
    monkeypatch.setattr(evidence, "write_report", lambda *_, **__: None)
    arguments = ["--cpu", "--minutes", "1", "--envs", "Venture", "--algos", "ppo,rnd,icm"]
    assert main([*arguments, "--at-once", "2", "--out", str(tmp_path / "new" / "out")]) == 2
    assert asked == [(["ppo", "rnd"], 30.0, False), (["icm"], 30.0, False)]
    assert "these runs failed: Venture rnd (status 1)" in capsys.readouterr().err
