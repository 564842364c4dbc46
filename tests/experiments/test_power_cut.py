"""Simulate power cuts in the strict sense of POSIX: what was not synced is lost.

While a run writes, every fsync copies what it makes permanent: the bytes of a file, or the names
in a directory. A cut leaves exactly these. The run is then resumed from what is left.
"""

import os
import random
import stat

import pytest
from helpers.processes import CAR, check_nothing_lost, lines, tree_of

from experiments.run import main

COMMAND = [*CAR, "algo=rnd", "total_steps=2048", "checkpoint_every=2"]


class Disk:
    """Record of what a power cut would leave of a directory at each moment."""

    def __init__(self, root, monkeypatch):
        """Start with an existing, empty directory, and watch every fsync."""
        self.root = root
        self.bytes: dict[int, bytes] = {}
        self.names: dict[int, dict[str, tuple[int, bool]]] = {}
        self.lost: list[tuple[dict, dict]] = []  # after each sync
        self.sync(root)
        fsync = os.fsync

        def watched(handle):
            fsync(handle)
            self.sync(os.readlink(f"/proc/self/fd/{handle}"))
            self.lost.append((dict(self.bytes), {k: dict(v) for k, v in self.names.items()}))

        monkeypatch.setattr(os, "fsync", watched)

    def sync(self, place):
        """Record the bytes of a file or the names in a directory as permanent."""
        inode = os.stat(place).st_ino
        if os.path.isdir(place):
            entries = list(os.scandir(place))
            self.names[inode] = {e.name: (e.inode(), e.is_dir()) for e in entries}
        elif stat.S_ISREG(os.stat(place).st_mode):
            with open(place, "rb") as file:
                self.bytes[inode] = file.read()

    def left(self, cut, where):
        """Write what remains after the cut of this number to another directory."""
        data, names = self.lost[cut]

        def directory(inode, path):
            path.mkdir()
            for name, (inner, inside) in names.get(inode, {}).items():
                if inside:
                    directory(inner, path / name)
                else:
                    (path / name).write_bytes(data.get(inner, b""))

        directory(os.stat(self.root).st_ino, where)


@pytest.mark.parametrize("cuts", [5, pytest.param(40, marks=pytest.mark.survival)])
def test_run_power_cut_resumes_from_a_complete_checkpoint(cuts, tmp_path, monkeypatch):
    path = tmp_path / "run"
    path.mkdir()
    with monkeypatch.context() as patch:
        disk = Disk(path, patch)
        assert main([*COMMAND, f"run_dir={path}"]) == 0
    assert len(disk.lost) > 40
    newest = 0
    chosen = sorted(random.Random(0).sample(range(len(disk.lost)), min(cuts, len(disk.lost))))
    for cut in chosen:
        left = tmp_path / f"left-{cut}"
        disk.left(cut, left)
        whole = [int(p.name) for p in left.glob("checkpoints/[0-9]*") if p.is_dir()]
        if whole:  # a named checkpoint is complete; a later cut leaves it or a newer one
            iteration, _ = tree_of(left)
            assert iteration == max(whole) >= newest
            newest = iteration
        assert main([*COMMAND, f"run_dir={left}", "resume=auto"]) == 0
        assert len(lines(left)) == 16
        check_nothing_lost(left, 16)
    assert newest > 0
