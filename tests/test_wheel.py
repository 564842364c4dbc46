"""The wheel in a fresh environment, used from an empty folder and from one that shadows us."""

import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from importlib.util import find_spec

import pytest
from helpers.processes import ROOT

# An environment made without ensurepip has no pip; then the system's Python has one (bootstrap.py).
PYTHON = sys.executable if find_spec("pip") else os.path.join(sys.base_prefix, "bin", "python3")
PIP = [PYTHON, "-m", "pip"]
QUICK = ["env=MountainCar", "algo=rnd", "num_envs=4", "rollout_length=32"]
QUICK += ["ppo.minibatch_size=64", "algo.minibatch_size=64", "total_steps=512"]
BOMB = "raise SystemExit('this is the experiments folder of the user')\n"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel, built from a copy of what the project tracks."""
    source = tmp_path_factory.mktemp("source")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    for name in ("sndjax", "experiments"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    out = tmp_path_factory.mktemp("wheel")
    build = [*PIP, "--python", sys.executable, "wheel", "-q", "--no-deps", "--no-build-isolation"]
    subprocess.run([*build, "-w", str(out), str(source)], check=True, capture_output=True)
    (found,) = out.glob("*.whl")
    return found


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """The bin/ of a fresh environment with the wheel; its dependencies are those of this one."""
    place = tmp_path_factory.mktemp("fresh")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(place)], check=True)
    python = place / "bin" / "python"
    pip = [*PIP, "--python", str(python), "install", "-q", "--no-deps"]
    subprocess.run([*pip, str(wheel)], check=True, capture_output=True)
    code = "import sysconfig; print(sysconfig.get_path('purelib'))"
    done = subprocess.run([str(python), "-c", code], capture_output=True, text=True, check=True)
    # A path file of ours is read, those of the other environment (its editable install) are not.
    with open(os.path.join(done.stdout.strip(), "dependencies.pth"), "w") as file:
        file.write(sysconfig.get_path("purelib") + "\n")
    return place / "bin"


def call(installed, arguments, cwd):
    """Run the installed command in a folder; what it printed."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    done = subprocess.run(
        [str(installed / "sndjax"), *arguments], cwd=cwd, env=environment, text=True,
        capture_output=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(params=["empty", "shadowed"])
def folder(request, tmp_path):
    """Where the command is used: empty, or with an `experiments` package of the user's own."""
    if request.param == "shadowed":
        (tmp_path / "experiments").mkdir()
        for name in ("__init__", "run", "cli", "report"):
            (tmp_path / "experiments" / f"{name}.py").write_text(BOMB)
        (tmp_path / "omegaconf.py").write_text(BOMB)  # what we import must be found elsewhere too
    return tmp_path


def test_wheel_holds_two_top_level_names_and_every_file(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.partition("/")[0] for name in names} - {
        name.partition("/")[0] for name in names if ".dist-info/" in name
    } == {"sndjax", "sndjax_lab"}
    tracked = subprocess.run(
        ["git", "ls-files", "sndjax", "experiments"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    ).stdout.split()  # fmt: skip
    assert {f"sndjax_lab/{name.removeprefix('experiments/')}" for name in tracked
            if name.startswith("experiments/")} <= set(names)  # fmt: skip
    assert {name for name in tracked if name.startswith("sndjax/")} <= set(names)


def test_installed_command_runs_sweeps_and_reports_in_any_folder(installed, folder):
    assert "finished: one" in call(installed, [*QUICK, "run_dir=one"], folder)
    shown = call(installed, ["-m", *QUICK, "seed=0,1", "hydra.sweep.dir=two"], folder)
    assert "2 jobs: 2 done" in shown
    assert (folder / "two" / "report" / "index.html").is_file()
    shown = call(installed, ["report", "one", "--out", "page"], folder)
    assert "page: " in shown
    assert (folder / "page" / "index.html").is_file()


def test_installed_module_is_not_called_experiments(installed, tmp_path):
    code = "from importlib.util import find_spec as find; "
    code += "print(find('experiments'), find('sndjax_lab').name)"
    python = [str(installed / "python"), "-c", code]
    done = subprocess.run(python, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["None", "sndjax_lab"]
