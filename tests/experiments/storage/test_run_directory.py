import dataclasses
import os
import subprocess
import sys

import pytest

from experiments.config.compose import load_config
from experiments.storage.run_directory import RunDirectory, new_run_path
from experiments.system.errors import ConfigError

CONFIG = load_config(["env=Venture", "algo=rnd"])


def at(path, **changes):
    return dataclasses.replace(CONFIG, run_dir=str(path), **changes)


def test_RunDirectory_empty_or_missing_is_taken_and_restored_on_failure(tmp_path):
    for path in (tmp_path / "empty", tmp_path / "new" / "deep"):
        if path.name == "empty":
            path.mkdir()
        RunDirectory(at(path)).discard()
    assert [p.name for p in tmp_path.iterdir()] == ["empty"]
    assert not any((tmp_path / "empty").iterdir())


def test_RunDirectory_with_files_is_refused_and_unchanged(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(ConfigError, match="not empty"):
        RunDirectory(at(tmp_path))
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_RunDirectory_in_use_is_refused_until_its_process_ends(tmp_path):
    code = (
        "import sys, time; from experiments.config.compose import load_config\n"
        "from experiments.storage.run_directory import RunDirectory\n"
        f"held = RunDirectory(load_config(['env=Venture', 'algo=rnd', 'run_dir={tmp_path}']))\n"
        "print('held', flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"held\n"
        with pytest.raises(ConfigError, match="in use by another run"):
            RunDirectory(at(tmp_path))
        process.kill()
    RunDirectory(at(tmp_path)).discard()


def test_RunDirectory_without_write_permission_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot write to"):
        RunDirectory(at(tmp_path / "file" / "run"))
    with pytest.raises(ConfigError, match="cannot write to"):
        RunDirectory(at("/proc/sndjax/run"))
    if os.geteuid():
        tmp_path.chmod(0o500)
        with pytest.raises(ConfigError, match="cannot write to"):
            RunDirectory(at(tmp_path / "run"))


def test_new_run_path_default_is_named_by_environment_and_algorithm():
    path = new_run_path(CONFIG)
    assert path.parts[:3] == ("runs", "Venture", "rnd")
    assert path != new_run_path(CONFIG)
    slashed = dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, name="a/b"))
    assert new_run_path(slashed).parts[1] == "a-b"
    up = dataclasses.replace(CONFIG, algo=dataclasses.replace(CONFIG.algo, name="../.."))
    assert new_run_path(up).parts[2] == "-.."
