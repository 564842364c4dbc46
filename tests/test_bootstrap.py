"""Tests of `make .venv` where it cannot continue: it prints one line and exits with status 2."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
START = "import runpy, sys, platform; sys.argv = ['bootstrap.py']; {}; runpy.run_path({!r}, run_name='__main__')"  # fmt: skip # noqa: E501


@pytest.mark.parametrize(
    ("before", "words"),
    [
        ("sys.version_info = (3, 9, 2)", "needs Python 3.11 or newer"),
        ("platform.machine = lambda: 'riscv64'", "is locked to wheels that Linux on x86-64"),
        ("sys.platform = 'darwin'", "is locked to wheels that Linux on x86-64"),
    ],
)
def test_bootstrap_unsupported_python_or_platform_exits_with_one_line(before, words, tmp_path):
    copy = tmp_path / "bootstrap.py"
    copy.write_text((ROOT / "bootstrap.py").read_text())
    code = START.format(before, str(copy))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1
    assert words in done.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["bootstrap.py"]


def test_bootstrap_without_network_exits_with_one_line(tmp_path):
    """The package index is at a port where nothing listens."""
    for name in ("bootstrap.py", "requirements.txt", "pyproject.toml"):
        (tmp_path / name).write_text((ROOT / name).read_text())
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PIP_")} | {
        "PIP_INDEX_URL": "http://127.0.0.1:9/simple",
        "PIP_RETRIES": "0",
        "PIP_CONFIG_FILE": os.devnull,
    }
    done = subprocess.run(
        [sys.executable, str(tmp_path / "bootstrap.py")],
        capture_output=True, text=True, env=environment, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr.splitlines() == [
        "sndjax: cannot reach the package index; connect to a network and run make .venv again"
    ]
    assert not (tmp_path / ".venv" / ".complete").exists()


def test_bootstrap_source_is_parsed_by_python_3_5():
    ast.parse((ROOT / "bootstrap.py").read_text(), feature_version=(3, 5))


def test_makefile_venv_missing_python_prints_what_to_install():
    done = subprocess.run(
        ["make", "-B", ".venv/.complete", "PYTHON=python9.9"],
        cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 2
    assert "sndjax: no python9.9 here; install Python 3.11 or newer" in done.stderr
