"""Test that a checkpoint is loaded only with the random generator that it was written with."""

import os
import shutil
import subprocess
import sys

import jax
import numpy as np
import pytest
from helpers.processes import CAR, ROOT

from experiments.run import main
from experiments.storage.array_trees import MANIFEST, read_manifest, write_tree
from experiments.storage.checkpoints import GENERATOR

DEFAULT = "threefry2x32"


def command(*arguments, generator, cwd):
    """Run a command of the laboratory with a random generator of jax."""
    return subprocess.run(
        [sys.executable, "-m", "experiments.cli", *arguments],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": str(ROOT), "JAX_DEFAULT_PRNG_IMPL": generator},
        capture_output=True,
        text=True,
        timeout=120,
    )


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    path = tmp_path_factory.mktemp("trained") / "run"
    assert main([*CAR, "algo=ppo", "total_steps=128", f"run_dir={path}"]) == 0
    return path


@pytest.fixture(scope="module")
def dump(tmp_path_factory):
    path = tmp_path_factory.mktemp("dump") / "run"
    more = ["algo=ppo", "ppo.value_weight=3e38", "total_steps=128"]
    assert main([*CAR, *more, f"run_dir={path}"]) == 1
    return path / "wrong-1"


@pytest.mark.parametrize("kind", ["resume", "evaluate", "record", "analyze", "replay"])
def test_command_under_another_generator_names_cause_and_remedy(kind, trained, dump, tmp_path):
    places = {"resume": [f"resume={trained}", "total_steps=256"], "replay": ["replay", str(dump)]}
    given = places.get(kind, [kind, str(trained)])
    found = command(*given, generator="rbg", cwd=tmp_path)
    assert found.returncode == 2, found.stderr
    (line,) = found.stderr.splitlines()
    assert f"are of jax's generator {DEFAULT}, but JAX_DEFAULT_PRNG_IMPL is rbg here" in line
    assert f"set JAX_DEFAULT_PRNG_IMPL={DEFAULT}" in line


def test_resume_with_the_variable_of_the_message_works(trained, tmp_path):
    copy = tmp_path / "run"
    shutil.copytree(trained, copy)
    found = command(f"resume={copy}", "total_steps=256", generator=DEFAULT, cwd=tmp_path)
    assert found.returncode == 0, found.stderr


def test_resume_generator_with_keys_of_the_same_shape_is_refused(tmp_path):
    run = ["run", *CAR, "algo=ppo", "total_steps=128", "run_dir=run"]
    assert command(*run, generator="rbg", cwd=tmp_path).returncode == 0
    more = ["resume=run", "total_steps=256"]
    found = command(*more, generator="unsafe_rbg", cwd=tmp_path)
    assert found.returncode == 2
    assert "generator rbg, but JAX_DEFAULT_PRNG_IMPL is unsafe_rbg" in found.stderr
    assert command(*more, generator="rbg", cwd=tmp_path).returncode == 0


def test_load_checkpoint_of_an_earlier_version_names_no_generator(trained, tmp_path):
    copy = tmp_path / "run"
    shutil.copytree(trained, copy)
    place = copy / "checkpoints" / "1"
    shutil.rmtree(copy / "checkpoints" / "0")
    manifest = read_manifest(place)
    assert manifest.pop(GENERATOR) == jax.config.jax_default_prng_impl == DEFAULT
    with np.load(place / "arrays.npz") as archive:
        arrays = dict(archive)
    write_tree(place, arrays, {k: v for k, v in manifest.items() if k != "arrays"})
    assert GENERATOR not in (place / MANIFEST).read_text()
    assert main([f"resume={copy}", "total_steps=256"]) == 0
