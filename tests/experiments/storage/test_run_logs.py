import hashlib
import json
import math

import pytest

from experiments.storage.episodes import Episode
from experiments.storage.run_logs import RunLogs, check_logs

ENTRY = {
    "iteration": 1,
    "step": 8,
    "transitions": 7,
    "frames": 32,
    "loss": 0.5,
}
CLOCK = {"wall_seconds": 2.0}


def log_pair(records, k):
    """Log iteration k of both seeds, which takes two seconds."""
    records.wall_seconds = 2.0 * k
    clock = records.log_times({"iteration": k, "steps_per_second": 4.0})
    for i in range(2):
        records.transitions[i] = 7 * k
        line = ENTRY | {"iteration": k, "step": 8 * k, "transitions": 7 * k}
        ended = [Episode(4 + i, 8 * k, 3, float(k), 10.0 * k, 0.1, 2)]
        records.log_iteration(i, ended, dict(line), clock)
    records.flush()


def filled(path, iterations=3, marked=0):
    """Return the logs of some iterations, and the manifest after iteration `marked`, if given."""
    path.mkdir(exist_ok=True)
    records, manifest = RunLogs(path, [4, 5], rooms=True, marks={}), None
    for k in range(1, iterations + 1):
        log_pair(records, k)
        if k == marked:
            manifest = records.manifest()
    return (records, manifest) if marked else records


def test_RunLogs_log_iteration_lines_are_json_without_nan_and_episodes_are_csv(tmp_path):
    records = filled(tmp_path)
    line = records.log_iteration(
        0, [], ENTRY | {"step": 32, "loss": math.nan, "other": math.inf}, CLOCK
    )
    records.flush()
    records.close()
    assert line["loss"] is None
    assert line["wall_seconds"] == 2.0
    assert line["ext_return"] is None
    lines = [json.loads(x) for x in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert lines[0]["seed"] == 4
    assert not any("second" in key or "rss" in key for key in lines[0])  # only in times.jsonl
    assert lines[0]["ext_return"] == 1
    assert lines[-1]["other"] is None
    rows = (tmp_path / "episodes.csv").read_text().splitlines()
    assert rows[0] == "seed,step,length,ext_return,score,int_return,rooms"
    assert rows[1] == "4,8,3,1.0,10.0,0.1,2"
    assert any((tmp_path / "tensorboard" / "seed_5").iterdir())


def test_RunLogs_log_iteration_reward_not_finite_is_null_in_every_file(tmp_path):
    records = filled(tmp_path)
    worse = Episode(4, 32, 3, math.nan, math.inf, 0.1, 2)
    line = records.log_iteration(0, [worse], ENTRY | {"step": 32}, CLOCK)
    assert (line["ext_return"], line["score"], line["last100_ext_return"]) == (None, None, None)
    records.flush()
    records.summarize(32)

    def strict(name):
        raise AssertionError(f"{name} is no JSON")

    figures = json.loads((tmp_path / "summary.json").read_text(), parse_constant=strict)
    assert figures["seeds"][0]["mean_ext_return"] is None
    assert figures["seeds"][1]["mean_ext_return"] == 2
    manifest = records.manifest()
    assert manifest["last100"] is None
    records.close()
    again = RunLogs(tmp_path, [4, 5], rooms=True, marks=manifest["logs"])
    assert math.isnan(again.summaries[0].last100)


def test_RunLogs_summarize_two_seeds_writes_one_object_per_seed(tmp_path):
    records = filled(tmp_path)
    records.summarize(24)
    seeds = json.loads((tmp_path / "summary.json").read_text())["seeds"]
    assert seeds[1] == {
        "seed": 5,
        "steps": 24,
        "episodes": 3,
        "mean_ext_return": 2.0,
        "max_ext_return": 3.0,
        "max_score": 30.0,
        "last100_ext_return": 2.0,
        "wall_seconds": 6.0,
    }


def test_RunLogs_resumed_cuts_later_lines_and_counts_earlier_ones(tmp_path):
    whole = filled(tmp_path / "a", 4)
    whole.summarize(32)
    killed, manifest = filled(tmp_path / "b", 3, marked=2)
    assert manifest["last100"] == 1.5
    killed.close()
    with (tmp_path / "b" / "metrics.jsonl").open("a") as file:
        file.write('{"step": 8, "se')  # killed while writing
    with (tmp_path / "b" / "times.jsonl").open("a") as file:
        file.write('{"iteration": 4}\n')
    with (tmp_path / "b" / "episodes.csv").open("a") as file:
        file.write("4,8")
    records = RunLogs(tmp_path / "b", [4, 5], rooms=True, marks=manifest["logs"])
    assert records.transitions == [14, 14]
    assert records.wall_seconds == 4.0
    for k in (3, 4):
        log_pair(records, k)
    read = list(records.read_back())
    assert [(line["iteration"], line["seed"]) for line in read] == [
        (k, seed) for k in (1, 2, 3, 4) for seed in (4, 5)
    ]
    assert [line["wall_seconds"] for line in read] == [2.0, 2.0, 4.0, 4.0, 6.0, 6.0, 8.0, 8.0]
    assert "rss_mb" in read[0]
    records.summarize(32)
    for name in ("metrics.jsonl", "episodes.csv", "summary.json"):
        assert (tmp_path / "a" / name).read_text() == (tmp_path / "b" / name).read_text()


def test_RunLogs_of_an_earlier_version_with_times_in_their_lines_resume(tmp_path):
    records, manifest = filled(tmp_path / "a", 2, marked=2)
    records.close()
    path = tmp_path / "a" / "metrics.jsonl"
    entries = [json.loads(line) for line in path.read_text().splitlines()]
    old = "".join(json.dumps(e | {"wall_seconds": 3.0 * e["iteration"]}) + "\n" for e in entries)
    path.write_text(old)
    (tmp_path / "a" / "times.jsonl").unlink()
    digest = hashlib.sha256(old.encode()).hexdigest()
    marks = {"episodes.csv": manifest["logs"]["episodes.csv"]}
    marks["metrics.jsonl"] = manifest["logs"]["metrics.jsonl"] | {"bytes": len(old)}
    marks["metrics.jsonl"]["sha256"] = digest
    check_logs(tmp_path / "a", [4, 5], marks)
    records = RunLogs(tmp_path / "a", [4, 5], rooms=True, marks=marks)
    assert records.wall_seconds == 6.0
    log_pair(records, 3)
    assert [line["wall_seconds"] for line in records.read_back()] == [3.0, 3.0, 6.0, 6.0, 6.0, 6.0]


def test_check_logs_changed_before_the_checkpoint_are_refused(tmp_path):
    records, manifest = filled(tmp_path / "a", 3, marked=2)
    records.close()
    check_logs(tmp_path / "a", [4, 5], manifest["logs"])
    with pytest.raises(ValueError, match=r"of another run"):
        check_logs(tmp_path / "a", [4], manifest["logs"])
    path = tmp_path / "a" / "episodes.csv"
    path.write_text(path.read_text().replace("5,8,3,1.0", "5,8,3,9.0"))
    with pytest.raises(ValueError, match=r"episodes.csv does not match its digest"):
        check_logs(tmp_path / "a", [4, 5], manifest["logs"])


def test_RunLogs_without_checkpoint_start_empty(tmp_path):
    filled(tmp_path / "a", 3).close()
    RunLogs(tmp_path / "a", [4, 5], rooms=True, marks={}).close()
    assert (tmp_path / "a" / "metrics.jsonl").read_text() == ""
    assert len((tmp_path / "a" / "episodes.csv").read_text().splitlines()) == 1
