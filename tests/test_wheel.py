"""The wheel in fresh environments: with the laboratory, and as the library alone."""

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from importlib.util import find_spec

import pytest
from helpers.processes import ROOT
from packaging.requirements import Requirement

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


@pytest.fixture(scope="module")
def core(wheel, tmp_path_factory):
    """The python of a fresh environment with the wheel and what it requires, from the index."""
    place = tmp_path_factory.mktemp("core")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(place)], check=True)
    python = place / "bin" / "python"
    pip = [*PIP, "--python", str(python), "install", "-q", "-c", str(ROOT / "requirements.txt")]
    subprocess.run([*pip, str(wheel)], check=True, capture_output=True)
    return python


INSTALLED = """
import importlib.metadata as metadata, json, re

norm = lambda name: re.sub("[-_.]+", "-", name).lower()
size = lambda one: sum(file.locate().stat().st_size for file in one.files if file.locate().exists())
print(json.dumps({norm(one.name): size(one) for one in metadata.distributions()}))
"""
JAX = {"jax", "jaxlib", "ml-dtypes", "numpy", "opt-einsum", "scipy"}


def installed_sizes(core):
    """Return the bytes of every package of the environment."""
    done = subprocess.run([core, "-c", INSTALLED], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def test_core_wheel_brings_the_library_alone_and_is_small(core):
    sizes = installed_sizes(core)
    laboratory = {"envpool", "gymnasium", "hydra-core", "matplotlib", "opencv-python-headless"}
    assert not laboratory & set(sizes)
    assert {"chex", "flax", "jax", "jaxtyping", "numpy", "optax", "sndjax"} <= set(sizes)
    # flax by itself brings orbax-checkpoint, and that tensorstore.
    ours = sum(sizes[name] for name in ("chex", "flax", "jaxtyping", "optax", "sndjax"))
    assert ours < 20e6


def test_core_wheel_runs_the_ten_lines_and_both_bonuses_reach_the_goal(core, tmp_path):
    shutil.copy(ROOT / "examples" / "purejaxrl_style.py", tmp_path)
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "XLA"))}
    done = subprocess.run(
        [core, "purejaxrl_style.py"], cwd=tmp_path, env=environment, text=True,
        capture_output=True, timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = re.findall(r"^(\S+) .* (\d) of 5 reach the goal", done.stdout, re.MULTILINE)
    assert found == [("PPO", "0"), ("RND", "5"), ("SND-VIC", "5")]


def test_core_wheel_command_says_how_to_install_the_laboratory(core):
    command = [core.parent / "sndjax", "env=MountainCar"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.endswith("run: pip install 'sndjax[lab]'")


TYPED = """
import jax
import jax.numpy as jnp

import sndjax

obs = jnp.zeros((8, 2))
bonus = sndjax.bonus("snd_vic", num_actions=3, example=obs, preset="small")
state = bonus.init(jax.random.key(0), obs)


def add(
    state: sndjax.BonusState, obs: jax.Array, action: jax.Array, after: jax.Array, done: jax.Array
) -> tuple[jax.Array, sndjax.BonusState]:
    reward, state, metrics = bonus.step(state, obs, action, after, done)
    return reward + metrics["int_reward_mean"], state
"""


def test_core_wheel_passes_mypy_strict_in_a_users_file(core, tmp_path):
    (tmp_path / "mine.py").write_text(TYPED)
    wrong = TYPED.replace("state: sndjax.BonusState, obs", "state: int, obs")
    (tmp_path / "wrong.py").write_text(wrong)
    mypy = [sys.executable, "-m", "mypy", "--strict", "--python-executable", str(core)]
    done = subprocess.run([*mypy, "mine.py"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    done = subprocess.run([*mypy, "wrong.py"], cwd=tmp_path, capture_output=True, text=True)
    assert 'incompatible type "int"; expected "BonusState"' in done.stdout


PLATFORMS = {
    ("linux", "x86_64"): [f"manylinux_2_{v}_x86_64" for v in (17, 27, 28)]
    + ["manylinux2014_x86_64"],
    ("linux", "aarch64"): [f"manylinux_2_{v}_aarch64" for v in (17, 27, 28)]
    + ["manylinux2014_aarch64"],
    ("darwin", "arm64"): [f"macosx_{v}_0_{a}" for v in (11, 12, 13, 14)
                          for a in ("arm64", "universal2")],
}  # fmt: skip
SOURCES = {"antlr4-python3-runtime"}  # pure Python that is published without a wheel


def find_wheels(requirements, platform, version, target):
    """Return the error of pip where one of these is not there for a platform, else nothing."""
    system, machine = platform
    there = {
        "python_version": version, "python_full_version": f"{version}.0", "sys_platform": system,
        "platform_machine": machine, "platform_system": system.capitalize(), "os_name": "posix",
    }  # fmt: skip
    wanted = []
    for line in requirements:
        one = Requirement(line)
        if (one.marker is None or one.marker.evaluate(there)) and one.name not in SOURCES:
            wanted.append(f"{one.name}{one.specifier}")
    names = [part for name in PLATFORMS[platform] for part in ("--platform", name)]
    pip = [*PIP, "install", "-q", "--dry-run", "--no-deps", "--only-binary=:all:"]
    done = subprocess.run(
        [*pip, "--python-version", version, *names, "--target", str(target), *wanted],
        capture_output=True, text=True,
    )  # fmt: skip
    return done.stderr if done.returncode else ""


def locked():
    """Return the lines of the lock."""
    lines = (ROOT / "requirements.txt").read_text().splitlines()
    return [line for line in lines if line and not line.startswith("#")]


EXHAUSTIVE = pytest.mark.exhaustive


@pytest.mark.parametrize(
    "version",
    [pytest.param("3.11", marks=EXHAUSTIVE), pytest.param("3.12", marks=EXHAUSTIVE), "3.13"],
)
@pytest.mark.parametrize("platform", PLATFORMS, ids="-".join)
def test_core_has_wheels_wherever_jax_does(platform, version, core, tmp_path):
    names = set(installed_sizes(core)) - {"sndjax"}
    norm = lambda line: re.sub("[-_.]+", "-", Requirement(line).name).lower()
    lines = [line for line in locked() if norm(line) in names]
    assert len(lines) > 20
    assert find_wheels(lines, platform, version, tmp_path) == ""


@pytest.mark.parametrize("platform", list(PLATFORMS)[1:], ids="-".join)
def test_lock_of_the_laboratory_has_wheels_on_arm(platform, tmp_path):
    """It contains what the library alone needs."""
    assert find_wheels(locked(), platform, "3.12", tmp_path) == ""
    if platform == ("linux", "aarch64"):
        unmarked = [line.partition(";")[0] for line in locked() if "PyQt5" in line]
        assert "PyQt5-Qt5" in find_wheels(unmarked, platform, "3.12", tmp_path)
