"""Test the budget of a sweep against values computed by hand."""

import json

from experiments.benchmarks import suite as benches
from experiments.benchmarks import sweep_budget as budget
from experiments.benchmarks.sweep_budget import RunCost, budget_tables
from experiments.sweeps import jobs as cells
from experiments.sweeps.multirun import compose_hydra

PRODUCT = cells.expand_product


def test_budget_tables_hours_and_disk_follow_from_the_measured_rates(tmp_path, monkeypatch):
    measured = {
        "rnd": {
            "steps_per_second": 50.0,
            "seconds_per_1000_steps": {"environment": 0.25},
            "peak_rss_mb": 2000.0,
        }
    }
    (tmp_path / "bench-cpu.json").write_text(json.dumps(measured))
    monkeypatch.setattr(benches, "RESULTS", tmp_path)
    kinds = {("rnd", "Atari"): RunCost(9, 3_600_000, 1.0, 200.0, 1000)}
    monkeypatch.setattr(budget, "sweep_costs", lambda sweep: kinds)
    monkeypatch.setattr(budget, "work_and_state", lambda algo, family: (1.0, 200.0))
    text = budget_tables("thesis", 16, 494.0)
    # 3.6M steps at 50 steps/s: 20 hours. 16 cores at 2,000 steps/s each: 32,000, 0.03 hours.
    row = next(line for line in text.splitlines() if line.startswith("| `rnd`"))
    shown = [cell.strip() for cell in row.strip("|").split("|")]
    disk = 3 * 200 + 3 * 1100 * 1000 / 1e6
    gpu = 2 * 200 + 129 * 128 * 96 * 96 / 1e6
    assert shown[2:] == ["9", "4", "1.00", "200", f"{gpu:.0f}", f"{disk:.0f}", "20", "0.0"]
    assert "9 runs, 180 hours on machines of two cores" in text
    assert "32,000 steps/s" in text
    assert "32 TFLOP/s" in text
    phases = {"steps_per_second": 900.0, "num_seeds": 1}
    gpu = {"sp": phases | {"whole_steps_per_second": 500.0}, "icm": phases}
    gpu["icm num_seeds=4"] = {"steps_per_second": 100.0, "num_seeds": 4}
    (tmp_path / "bench-gpu.json").write_text(json.dumps(gpu))
    text = budget_tables("thesis", 16, 494.0)
    row = next(line for line in text.splitlines() if line.startswith("| `rnd`"))
    assert row.endswith("| 20 | 2.0 |")  # without a measurement: as slow as the slowest
    assert "TFLOP/s" not in text


def test_expand_product_thesis_sweep_is_720_runs():
    params = compose_hydra(["sweep=thesis"]).sweeper.params
    runs = [tuple(one) for one in cells.expand_product([f"{k}={v}" for k, v in params.items()])]
    assert len(set(runs)) == 720
    assert sum("algo=snd_std" in run and "env=Venture" in run for run in runs) == 9


def test_sweep_costs_nine_seeds_are_counted_per_family(monkeypatch):
    monkeypatch.setattr(budget, "work_and_state", lambda algo, family: (1.0, 100.0))
    params = ["env=Venture,Climber", "algo=ppo", "seed=range(9)"]
    monkeypatch.setattr(cells, "expand_product", lambda _: PRODUCT(params))
    found = budget.sweep_costs("thesis")
    assert {key: kind[:2] for key, kind in found.items()} == {
        ("ppo", "Atari"): (9, 128_000_000),
        ("ppo", "Procgen"): (9, 64_000_000),
    }
