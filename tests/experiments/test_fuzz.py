"""Give thousands of bad inputs: each is refused in one line, with status 2 and no traceback."""

import hashlib
import json
import random
import re
import shutil
import string
from collections import Counter
from pathlib import Path

import pytest
import yaml
from helpers.processes import CAR, start

from experiments import replay
from experiments.analysis import update_replay
from experiments.config import validation as validate
from experiments.config.saved import read_saved
from experiments.run import main
from experiments.sweeps import multirun
from experiments.system.errors import ConfigError
from experiments.training import trainer as training

KEYS = [*(name for name, _ in validate.config_options()), "env", "algo"]
WORDS = [
    "", "0", "1", "-1", "2.5", "1e400", "nan", "inf", "-inf", "null", "true", "[]", "[1,2]", "{}",
    "{a:1}", "${x}", "${oc.env:HOME}", "${now:%Y}", "a,b", "range(3)", "'", '"', "\\", "[", "{",
    "(", "a b", "=", "==", "../../x", "/proc/x", "/dev/null", "~", "\n", "\t", "é", "雪",
    "9" * 400, "x" * 5000, "!!python/object:os.system", "auto", "Venture", "ppo", "rnd", "grid",
    "vicreg", "e3b", "sign", "goal", "Pong-v5", "NoSuch-v0", "a:b", "os:system", "x.py:f",
]  # fmt: skip
SWEEPS = ("-m", "--multirun", "--config", "--cfg=job", "-cd", "--", "-", "hydra.run.dir=x", "+a=1")


def word(draw):
    """Draw a value: a known problematic string, a number, or random characters."""
    kind = draw.random()
    if kind < 0.6:
        return draw.choice(WORDS)
    if kind < 0.8:
        return str(draw.choice([draw.randint(-(2**70), 2**70), draw.uniform(-1e3, 1e3)]))
    return "".join(draw.choice(string.printable) for _ in range(draw.randint(0, 12)))


def argument(draw):
    """Draw one argument that looks more or less like an option."""
    kind = draw.random()
    if kind < 0.05:
        return draw.choice(SWEEPS)
    if kind < 0.1:
        return word(draw)
    key = draw.choice(KEYS)
    if kind < 0.2:  # a typing error
        at = draw.randrange(len(key))
        key = key[:at] + draw.choice(["", "_", ".", "x"]) + key[at + 1 :]
    return draw.choice(["", "", "", "+", "++", "~"]) + key + "=" + word(draw)


def command(draw):
    """Draw arguments that are mostly wrong, sometimes after some valid ones."""
    begin = draw.choice([[], CAR, ["env=MountainCar", "algo=rnd"], ["env=Venture", "algo=snd_std"]])
    made = [*begin, *(argument(draw) for _ in range(draw.randint(0, 3)))]
    return [a for a in made if "\0" not in a]  # no command line can hold a null byte


def one_line(err):
    assert "Traceback" not in err, err
    assert len(err.strip("\n").splitlines()) == 1, err
    assert err.startswith("sndjax: "), err


@pytest.mark.parametrize("count", [100, pytest.param(2000, marks=pytest.mark.survival)])
def test_main_generated_command_lines_leave_no_traceback(count, tmp_path, monkeypatch, capfd):
    """Call main in this process; an accepted configuration or sweep is not trained."""
    monkeypatch.chdir(tmp_path)
    accepted = []
    monkeypatch.setattr(
        training, "train", lambda config, directory, interrupts: accepted.append(directory.path)
    )
    monkeypatch.setattr(multirun, "launch", lambda *_: accepted.append(tmp_path) or "")
    draw, refused = random.Random(count), 0
    for _ in range(count):
        arguments = command(draw)
        before = len(accepted)
        try:
            status = main(arguments)
        except BaseException as error:
            raise AssertionError(f"{arguments}") from error
        err = capfd.readouterr().err
        if len(accepted) > before or (status == 0 and {"-h", "--help", "help"} & {*arguments}):
            for entry in tmp_path.iterdir():
                shutil.rmtree(entry)
            continue
        assert status == 2, arguments
        one_line(err)
        assert not any(tmp_path.iterdir()), arguments
        refused += 1
    print(f"{count} command lines, {refused} refused")
    assert refused > count / 2


@pytest.mark.parametrize("count", [2, pytest.param(40, marks=pytest.mark.survival)])
def test_main_generated_command_lines_in_a_shell_make_no_traceback(count, tmp_path):
    draw = random.Random(count + 1)
    tried = 0
    while tried < count:
        arguments = ["env=MountainCar", "algo=rnd", "num_envs=2", "rollout_length=4"]
        arguments += ["ppo.minibatch_size=8", "algo.minibatch_size=8", "total_steps=8"]
        given = {a.split("=")[0] for a in arguments}
        more = [argument(draw) for _ in range(draw.randint(1, 3))]
        if any(a.lstrip("+~").split("=")[0] in given or len(a) > 10000 for a in more):
            continue
        try:
            process = start([*arguments, *more], tmp_path)
        except ValueError:
            continue  # an argument with a null byte
        tried += 1
        with process:
            _, err = process.communicate(timeout=120)
        assert process.returncode in (0, 1, 2), (more, err)
        if process.returncode == 2:
            one_line(err)
            assert not any(tmp_path.iterdir()), more
        assert "Traceback" not in err, (more, err)
        for entry in tmp_path.iterdir():
            shutil.rmtree(entry)


def harmed(data, draw):
    """Return the bytes with some of them flipped, removed, repeated or inserted."""
    data = bytearray(data)
    for _ in range(draw.randint(1, 3)):
        at = draw.randrange(len(data) + 1)
        kind = draw.random()
        if kind < 0.4 and at < len(data):
            data[at] ^= 1 << draw.randrange(8)
        elif kind < 0.6:
            del data[at : at + draw.choice([1, 10, 10**9])]
        elif kind < 0.8:
            data[at:at] = data[at : at + 50]
        else:
            data[at:at] = draw.choice(
                ["${oc.env:HOME}", "!!python/name:os", "&a [*a]", ": ", "\0"]
            ).encode()
    return bytes(data)


def changed(tree, draw):
    """Return JSON or YAML data with one value replaced, removed or added."""
    if isinstance(tree, dict) and tree and draw.random() < 0.9:
        key = draw.choice(sorted(tree))
        kind = draw.random()
        if kind < 0.1:
            return {k: v for k, v in tree.items() if k != key}
        if kind < 0.2:
            return tree | {draw.choice(WORDS): 1}
        return tree | {key: changed(tree[key], draw)}
    values = [None, -1, 0, 2, 10**30, -0.5, float("nan"), [], {}, [[]], True]
    return draw.choice([*values, *WORDS])


def changed_file(path, draw):
    """Return the file with one value changed; a manifest gets the digest of its new content."""
    if path.suffix == ".yaml":
        return yaml.safe_dump(changed(yaml.safe_load(path.read_text()), draw)).encode()
    manifest = json.loads(path.read_text())
    del manifest["sha256"]
    body = json.dumps(changed(manifest, draw), sort_keys=True)
    seal = hashlib.sha256(body.encode()).hexdigest()
    return f'{{"sha256": "{seal}", {body[1:]}'.encode()


def longer(path):
    """Return whether a damaged configuration is valid, but of a run too long for a test."""
    try:
        return read_saved(path).config.total_steps > 10_000
    except ConfigError:
        return False


@pytest.mark.parametrize("count", [15, pytest.param(300, marks=pytest.mark.survival)])
def test_run_resume_damaged_files_make_no_traceback(count, tmp_path, capfd, monkeypatch):
    """Resume with the real command: it finishes, or refuses in one line and changes nothing."""
    run, copy = tmp_path / "run", tmp_path / "copy"
    arguments = [*CAR, "algo=ppo", "total_steps=512", "checkpoint_every=2"]
    assert main([*arguments, f"run_dir={run}"]) == 0
    draw, refused = random.Random(count), 0
    files = [p.relative_to(run) for p in sorted(run.rglob("*")) if p.is_file()]
    named = [p for p in files if p.name in ("config.yaml", "metrics.jsonl", "episodes.csv")]
    rest = [p for p in files if "checkpoints" in p.parts]
    newest = max(int(p.name) for p in (run / "checkpoints").iterdir())
    sealed = [Path("config.yaml"), Path("checkpoints") / str(newest) / "manifest.json"]
    for _ in range(count):
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(run, copy)
        kind = draw.random()
        if kind < 0.4:
            target = copy / draw.choice(sealed)
            target.write_bytes(changed_file(target, draw))
        else:
            target = copy / draw.choice(named if kind < 0.7 else rest)
            target.write_bytes(harmed(target.read_bytes(), draw))
        if longer(copy / "config.yaml"):
            continue
        found = {p: p.read_bytes() for p in copy.rglob("*") if p.is_file()}
        capfd.readouterr()
        if target.name == "config.yaml":  # an accepted configuration is not trained
            with monkeypatch.context() as patch:
                patch.setattr(training, "train", lambda *_: None)
                assert main([f"repeat={target}", f"run_dir={tmp_path / 'again'}"]) in (0, 2)
            assert "Traceback" not in capfd.readouterr().err
            shutil.rmtree(tmp_path / "again", ignore_errors=True)
        status = main([f"resume={copy}"])
        err = capfd.readouterr().err
        if status == 2:
            refused += 1
            one_line(err)
            left = {p: p.read_bytes() for p in copy.rglob("*") if p.is_file()}
            assert left == found, target
        else:
            assert status == 0, (target, err)
            assert err == "", (target, err)
            entries = (copy / "metrics.jsonl").read_text().splitlines()
            iterations = [json.loads(entry)["iteration"] for entry in entries]
            assert iterations == list(range(1, max(4, len(entries)) + 1))
    print(f"{count} damaged files, {refused} refused, the others gone on from")


@pytest.mark.parametrize("count", [6, pytest.param(60, marks=pytest.mark.survival)])
def test_replay_damaged_dumps_make_no_traceback(count, tmp_path, capfd, monkeypatch):
    """Replay each dump up to the update, which is not run."""
    path, copy = tmp_path / "run", tmp_path / "copy"
    command = [*CAR, "algo=ppo", "ppo.value_weight=3e38", "total_steps=256"]
    assert main([*command, f"run_dir={path}"]) == 1
    monkeypatch.setattr(update_replay, "replay_update", lambda *_: None)
    assert replay.main([str(path / "wrong-1")]) == 0
    draw = random.Random(count)
    for _ in range(count):
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(path / "wrong-1", copy)
        target = copy / "manifest.json"
        if draw.random() < 0.5:
            target = draw.choice(sorted(p for p in copy.rglob("*") if p.is_file()))
            target.write_bytes(harmed(target.read_bytes(), draw))
        else:
            target.write_bytes(changed_file(target, draw))
        capfd.readouterr()
        status = replay.main([str(copy)])
        err = capfd.readouterr().err
        assert status in (0, 2), (target, err)
        if status == 2:
            one_line(err)


def test_read_saved_and_other_readers_of_stored_data_execute_nothing():
    """Search the code for pickle, eval, exec and other unsafe readers of stored data."""
    readers = re.compile(r"pickle|\beval\(|\bexec\(|yaml\.(load|unsafe)|np\.load")
    root = validate.CONF.parents[1]
    files = [*(root / "sndjax").rglob("*.py"), *(root / "experiments").rglob("*.py")]
    lines = [(f.name, line) for f in files for line in f.read_text().splitlines()]
    refused = "allow_pickle=False"  # NumPy then reads plain numbers or raises
    found = [name for name, line in lines if refused not in line and readers.search(line)]
    assert len(files) > 40
    # saved.py uses a loader of plain data only; the others run the script they are given
    assert Counter(found) == {"saved.py": 1, "run_script.py": 2, "pure_jax.py": 1}
