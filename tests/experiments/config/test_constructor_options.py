"""Options read from source against what Python itself says of the constructors."""

import inspect
import math
import typing
from types import NoneType

import pytest

from experiments.config.constructor_options import read_constructor
from experiments.config.library import library_path, module_names
from experiments.system.errors import ConfigError
from sndjax import objectives, signals

ALL = [("objectives", n) for n in module_names("objectives")]
ALL += [("signals", n) for n in module_names("signals")]


@pytest.mark.parametrize(("folder", "name"), ALL)
def test_read_constructor_equals_the_signature_that_python_reports(folder, name):
    make = getattr({"objectives": objectives, "signals": signals}[folder], name)
    hints = typing.get_type_hints(make, include_extras=True)
    found = read_constructor(library_path() / folder / f"{name}.py", name)
    assert found.about
    assert found.about.splitlines()[0] == inspect.getdoc(make).splitlines()[0]
    wanted = {
        key: parameter.default
        for key, parameter in inspect.signature(make).parameters.items()
        if parameter.default is not inspect.Parameter.empty
    }
    assert {key: entry.default for key, entry in found.options.items()} == wanted
    for key, entry in found.options.items():
        hint, extras = hints[key], ()
        if typing.get_origin(hint) is typing.Annotated:
            hint, *extras = typing.get_args(hint)
        if typing.get_origin(hint) is typing.Literal:
            assert entry.metadata["choices"] == typing.get_args(hint)
            assert entry.type is str
        else:
            assert entry.type is hint, key
        bounds = extras[0]._asdict() if extras else dict.fromkeys(("low", "above", "high"))
        assert {bound: entry.metadata[bound] for bound in bounds} == bounds, key
        assert len(entry.metadata["about"]) > 5, f"{key} has no line under Args:"


USER = '''
from typing import Annotated, Literal

import a_package_that_is_not_installed
from sndjax.ranges import Range, Share
from sndjax.signals.distillation import RewardReduction as Reduction

Kind = Literal["near", "far"]
Turn = Back
Back = Turn


def mine(
    num_actions,
    size,
    temperature: float = 1 / 4,
    steps=3,
    kind: Kind = "near",
    reduce: Reduction = "mean",
    share: Share = 0.5,
    decay: Annotated[float | None, Range(0.0, high=2 * 4)] = None,
    on: bool = False,
    table: dict = {},
    net=object(),
    level: Literal[1, 2] = 1,
    depth: Optional[int] = None,
    broken=1 / 0,
    also=-"x",
    endless: Turn = 1,
    big=9**9,
):
    """Make my module.

    Args:
      temperature: of the softmax, which
        is long.
      steps: so many.
    """
'''


def test_read_constructor_of_a_users_file_reads_its_arguments_without_running_it(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(USER)
    options = read_constructor(path, "mine").options
    assert {key: entry.default for key, entry in options.items()} == {
        "temperature": 0.25, "steps": 3, "kind": "near", "reduce": "mean", "share": 0.5,
        "decay": None, "on": False, "level": 1, "depth": None, "endless": 1,
    }  # fmt: skip
    assert (options["level"].type, options["level"].metadata["choices"]) == (int, ("1", "2"))
    assert set(typing.get_args(options["depth"].type)) == {int, NoneType}
    assert [options[key].type for key in ("temperature", "steps", "kind", "on")] == [
        float, int, str, bool,
    ]  # fmt: skip
    assert options["kind"].metadata["choices"] == ("near", "far")
    assert options["reduce"].metadata["choices"] == ("mean", "half_sum", "norm")
    assert (options["share"].metadata["above"], options["share"].metadata["high"]) == (0, 1)
    assert (options["decay"].metadata["low"], options["decay"].metadata["high"]) == (0, 8)
    assert set(typing.get_args(options["decay"].type)) == {float, NoneType}
    assert options["temperature"].metadata["about"] == "of the softmax, which is long"
    assert math.isclose(options["temperature"].default, 0.25)


def test_read_constructor_leaves_out_what_is_passed_and_what_has_no_name(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text("def f(n=1, size=3, t=0.1, *, on=True): ...\ndef g(n, t=0.1, /, u=2): ...")
    defaults = lambda name, **given: {
        k: v.default for k, v in read_constructor(path, name, **given).options.items()
    }
    assert defaults("f") == {"n": 1, "size": 3, "t": 0.1, "on": True}
    assert defaults("f", given=2) == {"t": 0.1, "on": True}
    assert defaults("g") == {"u": 2}


def test_read_constructor_of_a_file_without_it_is_none_and_of_a_broken_one_refused(tmp_path):
    path, broken = tmp_path / "other.py", tmp_path / "broken.py"
    path.write_text("from elsewhere import mine")
    assert read_constructor(path, "mine") is None
    broken.write_text("(")
    with pytest.raises(ConfigError, match=r"broken\.py cannot be read"):
        read_constructor(broken, "mine")
