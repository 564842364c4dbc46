import subprocess
import sys
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import example, given, settings
from hypothesis import strategies as st

from experiments.config import command_text as command
from experiments.config.command_text import (
    command_text,
    option_text,
    path_text,
    replay_command,
    resume_command,
    shell_text,
    sweep_command,
)
from experiments.config.compose import load_config
from experiments.config.tool_options import TRUST, parse_arguments
from experiments.evaluate import Options

TEXT = st.text(st.characters(codec="utf-8", exclude_characters="\0"), min_size=1, max_size=12)
SPECIAL = st.text(
    alphabet=" =,'\"\\${}[]()/.:-+%~#!*?;&|<>`@^abnull1e5_é\n\t", min_size=1, max_size=9
)
READER = OverridesParser.create()
NAMED = [
    "null",
    "True",
    "nan",
    "-inf",
    "1e5",
    "007",
    "1_0",
    "a b",
    "a=b",
    "a,b",
    "x\\",
    "'\"",
    "'\\\"x",
    "é",
]


def read_by_bash(words):
    """Return the arguments that bash makes of a text."""
    printed = subprocess.run(
        ["bash", "-c", f"printf '%s\\0' {words}"], capture_output=True, check=True
    )
    return printed.stdout.decode().split("\0")[:-1]


@pytest.mark.parametrize("text", NAMED)
def test_option_text_named_values_are_read_by_hydra_as_they_are(text):
    assert READER.parse_override(option_text("resume", text)).value() == text


@settings(deadline=None, max_examples=300)
@given(TEXT | SPECIAL)
@example("\\'\"\\")
def test_option_text_generated_values_are_read_by_hydra_as_they_are(text):
    value = READER.parse_override(option_text("resume", text)).value()
    assert (type(value), value) == (str, text)


@settings(deadline=None, max_examples=100)
@given(st.lists(TEXT | SPECIAL, min_size=1, max_size=4))
def test_shell_text_generated_arguments_are_read_by_bash_as_they_are(arguments):
    line = " ".join(map(shell_text, arguments))
    assert len(line.splitlines()) == 1
    assert read_by_bash(line) == arguments


@pytest.mark.parametrize("text", ["a b/x=1,y", "x=1", "-h", "--out", "-m=1", "a", "/a/b=c"])
def test_path_text_every_command_takes_it_for_a_path(text):
    (path,), _ = parse_arguments([path_text(Path(text))], Options)
    assert path == Path(text)


def test_command_text_program_is_one_that_the_shell_finds(monkeypatch, tmp_path):
    script = Path(sys.executable).parent / "sndjax"
    if script.is_file():
        monkeypatch.setenv("PATH", f"{script.parent}")
        assert command_text("a b") == "sndjax 'a b'"
        monkeypatch.setenv("PATH", "/usr/bin:/bin")
        assert command_text() == shell_text(str(script)) or command_text().endswith("bin/sndjax")
        other = tmp_path / "sndjax"  # another version that the shell finds first
        other.write_text("#!/bin/sh\n")
        other.chmod(0o755)
        monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
        assert command_text() != "sndjax"
    monkeypatch.setattr(sys, "executable", "/my python/bin/python3")
    monkeypatch.setenv("PATH", "/usr/bin:/bin")
    assert command_text("x") == f"'/my python/bin/python3' -m {command.PACKAGE}.cli x"


def test_resume_and_replay_command_name_the_users_task_and_module(tmp_path):
    code = tmp_path / "my code, v=1.py"
    code.write_text("")
    options = ["env.id=mine:Task-v0", option_text("algo.module", f"{code}:bonus")]
    made = load_config(["env=gymnasium", *options])
    for line, first in (
        (resume_command(Path("my run/a=b,c"), made), ['resume="my run/a=b,c"']),
        (replay_command(Path("my run/a=b,c/wrong-1"), made), ["replay", "my run/a=b,c/wrong-1"]),
    ):
        *words, module, task = read_by_bash(line)
        values = [READER.parse_override(word).value() for word in (module, task)]
        assert values == [f"{code}:bonus", "mine:Task-v0"]
        assert words[-len(first) :] == first
    plain = load_config(["env=MountainCar", "algo=ppo"])
    assert resume_command(Path("runs/x"), plain).endswith("sndjax resume=runs/x")
    assert resume_command(Path("auto"), plain).endswith("resume=./auto")


def test_sweep_command_repeats_the_arguments_with_the_directory_once():
    given = [
        "-m",
        "env=MountainCar",
        "algo.module=choice('a b.py:f','c.py:g')",
        "hydra.sweep.dir=x",
    ]
    line = sweep_command(given, Path("/my sweeps/a=b"))
    assert read_by_bash(line)[-4:] == [*given[:3], 'hydra.sweep.dir="/my sweeps/a=b"']


def test_parse_arguments_code_of_the_run_is_trusted_also_when_quoted():
    module = "my code/b=1,c.py:f"
    quoted = option_text("algo.module", module)
    _, options = parse_arguments(["runs/x", quoted, "env.id=mine:T-v0", "trust=third"], Options)
    assert options.trust == (module, "mine:T-v0", "third")
    _, options = parse_arguments(["runs/x", "--algo.module", module], Options)
    assert options.trust == (module,)
    assert "algo.module=" in TRUST
