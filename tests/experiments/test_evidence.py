"""`make gpu-evidence`, on what there is: a CPU and a task of seconds."""

import json

from experiments import evidence
from experiments.evidence import main


def test_without_a_gpu_nothing_is_run_and_it_says_so(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(evidence, "backend", lambda: "cpu")
    assert main(["--out", str(tmp_path / "out")]) == 2
    assert "jax sees no GPU here: not run" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_runs_stop_at_their_share_of_the_time_and_go_on_when_called_again(tmp_path):
    out = tmp_path / "out"
    arguments = ["--cpu", "--minutes", "0.4", "--envs", "MountainCar", "--algos", "rnd"]
    reached = []
    for _ in range(2):
        assert main([*arguments, "--out", str(out)]) == 0
        lines = (out / "MountainCar" / "rnd" / "metrics.jsonl").read_text().splitlines()
        reached.append(json.loads(lines[-1])["step"])
        assert list((out / "MountainCar" / "rnd" / "checkpoints").iterdir())
        assert (out / "report" / "index.html").is_file()
    assert 0 < reached[0] < reached[1] <= 1_003_520


def test_side_by_side_each_has_the_whole_time_and_says_what_it_does_in_a_file(tmp_path, capsys):
    out, algos = tmp_path / "out", ["ppo", "rnd"]
    arguments = ["--cpu", "--minutes", "0.5", "--envs", "MountainCar", "--algos", ",".join(algos)]
    assert main([*arguments, "--at-once", "2", "--out", str(out)]) == 0
    assert "MountainCar ppo, MountainCar rnd: 0.5 minutes" in capsys.readouterr().out
    for algo in algos:
        assert list((out / "MountainCar" / algo / "checkpoints").iterdir())
        said = (out / "MountainCar" / f"{algo}.log").read_text()
        assert f"MountainCar {algo}, 1 seed(s)" in said
        assert "step 4,096" in said
