import random
import subprocess
import sys
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sndjax
from experiments.storage import array_trees
from experiments.storage import checkpoints as checkpoint
from experiments.storage.array_trees import CheckpointError
from experiments.storage.checkpoints import Checkpoints, unwrap_keys
from experiments.training.agents import make_init_states
from sndjax.algorithms import NAMED


def first_state(name, width=16):
    size = sndjax.VECTOR._replace(features=width, hidden=(8, 8))
    make = NAMED[name]
    motivation = sndjax.IntrinsicConfig(make(3, size)) if make else None
    network = sndjax.ActorCritic(size, 3, 2 if make else 1)
    agent = sndjax.AgentSpec(network, sndjax.Hyperparameters(), motivation)
    return make_init_states(agent)([0, 1], jnp.zeros((4, 2)))


def fits(manifest):
    """Accept every manifest."""


def restore(path, like, fits=fits):
    """Return the newest complete iteration, its state and manifest, and messages about others."""
    checkpoints = Checkpoints(path)
    step, manifest, said = checkpoints.find(fits)
    if step is None:
        return None
    return step, checkpoints.load(step, jax.eval_shape(lambda: like)), manifest, said


def saved(path, state, steps, returns=()):
    """Save a checkpoint of the state at each of some iterations; return the Checkpoints."""
    checkpoints = Checkpoints(path)
    for i, step in enumerate(steps):
        more = {"last100": returns[i] if i < len(returns) else None}
        checkpoints.save(step, state._replace(iteration=state.iteration + step), more)
    checkpoints.wait()
    return checkpoints


@pytest.fixture(scope="module")
def state():
    return first_state("snd_vic")


@pytest.mark.parametrize("name", NAMED)
def test_Checkpoints_load_saved_state_is_identical(name, tmp_path):
    state = first_state(name)
    assert restore(tmp_path, state) is None
    saved(tmp_path, state, [1, 2, 3])
    iteration, restored, manifest, said = restore(tmp_path, state)
    assert (iteration, manifest["iteration"], said) == (3, 3, [])
    state = state._replace(iteration=state.iteration + 3)
    assert jax.tree.structure(state) == jax.tree.structure(restored)
    for one, other in zip(
        jax.tree.leaves(unwrap_keys(state)), jax.tree.leaves(unwrap_keys(restored)), strict=True
    ):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


def test_Checkpoints_save_donated_state_is_written_correctly(state, tmp_path, monkeypatch):
    go_on, written = threading.Event(), checkpoint.write_tree
    monkeypatch.setattr(checkpoint, "write_tree", lambda *args: go_on.wait(10) and written(*args))
    checkpoints = Checkpoints(tmp_path)
    mine = jax.tree.map(jnp.copy, state)
    checkpoints.save(0, mine, {})
    assert checkpoints.newest is None  # save returns before the disk has the data
    for leaf in jax.tree.leaves(mine):
        leaf.delete()
    go_on.set()
    checkpoints.wait()
    restored = restore(tmp_path, state)[1]
    for one, other in zip(
        jax.tree.leaves(unwrap_keys(state)), jax.tree.leaves(unwrap_keys(restored)), strict=True
    ):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    ("returns", "kept"),
    [
        ([None] * 5, [4, 5]),
        ([0.0, 3.0, 1.0, 2.0, 1.0], [2, 4, 5]),
        ([0.0, 1.0, 1.0, 0.0, 0.0], [3, 4, 5]),  # of two equal best ones, the newer
        ([0.0, 0.0, 0.0, 1.0, 2.0], [4, 5]),
        ([float("nan"), 1.0, float("inf"), 0.0, 0.0], [2, 4, 5]),
    ],
)
def test_Checkpoints_save_keeps_the_newest_two_and_the_best(returns, kept, state, tmp_path):
    assert saved(tmp_path, state, [1, 2, 3, 4, 5], returns).steps() == kept


def test_Checkpoints_resumed_later_checkpoints_are_removed(state, tmp_path):
    saved(tmp_path, state, [10, 20])
    (tmp_path / "checkpoints" / "20" / "manifest.json").write_text("{")
    checkpoints = Checkpoints(tmp_path)
    assert checkpoints.find(fits)[0] == 10
    checkpoints.save(15, state._replace(iteration=state.iteration + 15), {})
    checkpoints.wait()
    assert checkpoints.steps() == [10, 15]


class Bomb:
    """Object that creates a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


def test_read_tree_arrays_with_code_are_refused(state, tmp_path, monkeypatch):
    """Skip the check of the manifest, so that only the reader of the arrays can refuse."""
    saved(tmp_path, state, [1])
    path, trace = tmp_path / "checkpoints" / "1", tmp_path / "trace"
    np.savez(path / "arrays.npz", **{"policy": np.array([Bomb(trace)], dtype=object)})
    monkeypatch.setattr(array_trees, "verify_manifest", lambda path: {})
    with pytest.raises(CheckpointError, match="allow_pickle=False"):
        array_trees.read_tree(path, jax.eval_shape(lambda: unwrap_keys(state)))
    assert not trace.exists()


def test_Checkpoints_save_arrays_are_readable_by_numpy(state, tmp_path):
    saved(tmp_path, state, [1])
    archive = np.load(tmp_path / "checkpoints" / "1" / "arrays.npz")
    assert len(archive.files) == len(jax.tree.leaves(state))
    written = archive["policy/params/Dense_0/bias"]
    np.testing.assert_array_equal(written, state.policy["params"]["Dense_0"]["bias"])


def every_file(path):
    return sorted(p for p in path.rglob("*") if p.is_file() and p.stat().st_size)


def test_Checkpoints_find_one_flipped_bit_uses_the_previous(state, tmp_path):
    saved(tmp_path, state, [1, 2])
    draw = random.Random(0)
    for file in every_file(tmp_path / "checkpoints" / "2"):
        whole = file.read_bytes()
        for _ in range(20):
            flipped = bytearray(whole)
            flipped[draw.randrange(len(whole))] ^= 1 << draw.randrange(8)
            file.write_bytes(flipped)
            iteration, _, _, said = restore(tmp_path, state)
            assert iteration == 1, file
            assert len(said) == 1
            assert "checkpoint 2 cannot be used" in said[0]
        file.write_bytes(whole)
    assert restore(tmp_path, state)[0] == 2


def test_Checkpoints_find_missing_cut_or_unfitting_file_uses_the_previous(state, tmp_path):
    saved(tmp_path, state, [1, 2])
    for file in every_file(tmp_path / "checkpoints" / "2"):
        whole = file.read_bytes()
        for harm in (file.unlink, lambda file=file, whole=whole: file.write_bytes(whole[:-1])):
            harm()
            assert restore(tmp_path, state)[0] == 1, file
            file.write_bytes(whole)

    def newer_does_not_fit(manifest):
        if manifest["iteration"] == 2:
            raise ValueError("metrics.jsonl does not match its digest")

    iteration, _, _, said = restore(tmp_path, state, newer_does_not_fit)
    assert iteration == 1
    assert "metrics.jsonl does not match its digest" in said[0]


def test_Checkpoints_find_all_damaged_raises(state, tmp_path):
    saved(tmp_path, state, [1, 2])
    for step in "12":
        (tmp_path / "checkpoints" / step / "manifest.json").unlink()
    with pytest.raises(CheckpointError, match=r"checkpoint 2.*checkpoint 1"):
        restore(tmp_path, state)


def test_Checkpoints_load_state_of_another_iteration_is_refused(state, tmp_path):
    saved(tmp_path, state, [7])
    (tmp_path / "checkpoints" / "7").rename(tmp_path / "checkpoints" / "8")
    with pytest.raises(CheckpointError, match="of another iteration"):
        restore(tmp_path, state)


def test_Checkpoints_save_state_of_another_iteration_is_refused(state, tmp_path):
    checkpoints = saved(tmp_path, state, [1])
    with pytest.raises(CheckpointError, match="not that of iteration 2"):
        checkpoints.save(2, state._replace(iteration=state.iteration + 3), {})
    assert checkpoints.steps() == [1]


def test_Checkpoints_steps_directory_without_a_number_is_ignored(state, tmp_path):
    saved(tmp_path, state, [1])
    for name in ("\u00b2", "-3", "1.5", "x"):
        (tmp_path / "checkpoints" / name).mkdir()
    assert Checkpoints(tmp_path).steps() == [1]


def test_Checkpoints_load_other_shapes_are_refused(state, tmp_path):
    saved(tmp_path, state, [1])
    with pytest.raises(CheckpointError, match=r"float32\[2, .*16.*\], not float32\[2, .*12"):
        restore(tmp_path, first_state("snd_vic", width=12))


def test_write_tree_interrupted_leaves_no_checkpoint(state, tmp_path, monkeypatch):
    saved(tmp_path, state, [1])

    def killed(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(array_trees, "fsync_path", killed)
    with pytest.raises(KeyboardInterrupt):
        array_trees.write_tree(tmp_path / "checkpoints" / "2", {"a": np.ones(3)}, {})
    assert [p.name for p in (tmp_path / "checkpoints").iterdir()] == ["1"]


def test_Checkpoints_wait_failed_save_raises_and_keeps_the_previous(state, tmp_path, monkeypatch):
    checkpoints = saved(tmp_path, state, [1])

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(array_trees, "fsync_path", full)
    checkpoints.save(2, state._replace(iteration=state.iteration + 2), {})
    with pytest.raises(OSError, match=r"No space left.*the checkpoint of iteration 1 is intact"):
        checkpoints.wait()
    monkeypatch.undo()
    assert restore(tmp_path, state)[0] == 1


@pytest.mark.survival
def test_write_tree_many_times_keeps_memory_constant(tmp_path):
    code = f"""
from pathlib import Path
import numpy as np
from experiments.storage.array_trees import write_tree
from experiments.system.process import rss_mb
tree = {{f"a{{i}}": np.random.default_rng(i).normal(size=(64, 64)) for i in range(60)}}
for k in range(601):
    write_tree(Path({str(tmp_path)!r}) / str(k % 3), tree, {{}})
    if k % 100 == 0:
        print(rss_mb())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    memory = [float(line) for line in done.stdout.split()]
    print("MB after every hundred checkpoints:", *(f"{value:.0f}" for value in memory))
    assert memory[-1] < 1.02 * memory[-4]
