"""The house rules that a script can count, held: see measure_style.py."""

import pytest
from measure_style import measure


@pytest.mark.parametrize("folder", ["sndjax", "experiments"])
def test_measure_of_a_folder_finds_nothing_that_breaks_the_rules(folder):
    found = measure(folder)
    for name in ("no_args", "long_modules", "long_functions"):
        assert not found[name][0], name
    places, count = found["no_verb"]
    assert len(places) < 0.05 * count, places
    if folder == "sndjax":
        assert not found["inner_untyped"][0]


def test_measure_of_bad_code_finds_it(tmp_path, monkeypatch):
    bad = (
        '"""M."""\n\n\ndef f(a, b, c):\n    """What it is."""\n\n    def g(x):\n        return x\n'
    )
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "m.py").write_text(bad + 300 * "# x\n")
    monkeypatch.setattr("measure_style.ROOT", tmp_path)
    found = {name: len(places) for name, (places, _) in measure("bad").items()}
    assert found == {
        "no_args": 1, "no_verb": 1, "inner_untyped": 1, "long_modules": 1, "long_functions": 0,
    }  # fmt: skip
