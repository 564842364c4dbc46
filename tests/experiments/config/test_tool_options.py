from dataclasses import dataclass
from pathlib import Path

import pytest

from experiments.config.option import option
from experiments.config.tool_options import parse_arguments, tool_help
from experiments.system.errors import ConfigError


@dataclass(frozen=True)
class Own:
    out: str = option("report", "where it goes")
    live: bool = option(False, "go on")
    states: int = option(100, "how many", low=10)
    rate: float = option(0.5, "how fast", high=1)
    agent: str | None = option(None, "who", choices=None)


@pytest.mark.parametrize(
    ("given", "places", "wanted"),
    [
        ([], [], Own()),
        (["runs/a=b", "out=x"], [Path("runs/a=b")], Own(out="x")),
        (["--out", "x", "a", "--live"], [Path("a")], Own(out="x", live=True)),
        (["states=1_000", "--rate=0.25", "live=true"], [], Own(states=1000, rate=0.25, live=True)),
        (["agent=runs/x"], [], Own(agent="runs/x")),
        (["states=1e3", "rate=1e-1"], [], Own(states=1000, rate=0.1)),
        (["--states", "20.0"], [], Own(states=20)),
    ],
)
def test_parse_arguments_key_value_and_dashes_give_the_same(given, places, wanted):
    assert parse_arguments(given, Own) == (places, wanted)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["outt=x"], "did you mean out"),
        (["states=9"], "at least 10"),
        (["states=many"], "a whole number"),
        (["states=20.5"], "a whole number"),
        (["states=1e400"], "a whole number"),
        (["live=maybe"], "true or false"),
        (["rate=2"], "at most 1"),
        (["rate=nan"], "finite"),
        (["--out"], "needs a value"),
        (["out=a", "--out", "b"], "given twice"),
    ],
)
def test_parse_arguments_bad_input_raises_with_the_option_named(given, said):
    with pytest.raises(ConfigError, match=said):
        parse_arguments(given, Own)


def test_tool_help_options_are_all_named():
    text = tool_help("About.", Own)
    assert all(name in text for name in ("out=report", "live=False", "states=100", "how fast"))
