"""A budget, recomputed by hand."""

import json

from experiments import benches, budget
from experiments.budget import Kind, Options, report


def test_hours_and_disk_are_those_of_the_measured_rates(tmp_path, monkeypatch):
    measured = {
        "rnd": {
            "steps_per_second": 50.0,
            "seconds_per_1000_steps": {"environment": 0.25},
            "peak_rss_mb": 2000.0,
        }
    }
    (tmp_path / "bench-cpu.json").write_text(json.dumps(measured))
    monkeypatch.setattr(benches, "RESULTS", tmp_path)
    kinds = {("rnd", "Atari"): Kind(9, 3_600_000, 1.0, 200.0, 1000)}
    monkeypatch.setattr(budget, "kinds_of", lambda sweep: kinds)
    monkeypatch.setattr(budget, "weight", lambda algo, family: (1.0, 200.0))
    text = report(Options(cores=16))
    # 3.6M steps at 50 a second: 20 hours. 16 cores at 2,000 a second each: 32,000, 0.03 hours.
    row = next(line for line in text.splitlines() if line.startswith("| `rnd`"))
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    disk = 3 * 200 + 3 * 1100 * 1000 / 1e6
    gpu = 2 * 200 + 129 * 128 * 96 * 96 / 1e6
    assert cells[2:] == ["9", "4", "1.00", "200", f"{gpu:.0f}", f"{disk:.0f}", "20", "0.0"]
    assert "9 runs, 180 hours on machines of two cores" in text
    assert "32,000 steps/s" in text
    assert "32 TFLOP/s" in text


def test_the_thesis_is_720_runs(monkeypatch):
    monkeypatch.setattr(budget, "weight", lambda algo, family: (1.0, 100.0))
    found = budget.kinds_of("thesis")
    assert sum(kind.runs for kind in found.values()) == 720
    assert found["snd_std", "Atari"][:2] == (54, 128_000_000)
    assert found["ppo", "Procgen"][:2] == (36, 64_000_000)
