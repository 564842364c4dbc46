import pytest

from experiments.reporting.plot_style import STYLES, line_style, line_styles

LOOK = ("color", "linestyle", "marker")


def looks(series):
    return [tuple(style[key] for key in LOOK) for style in line_styles(series).values()]


@pytest.mark.parametrize("cells", [1, 3, 4, 5, 9, 40, 700])
@pytest.mark.parametrize("algo", ["grid", "rnd", "my_bonus"])
def test_line_styles_settings_of_one_algorithm_all_differ(algo, cells):
    found = looks([(algo, f"{algo} (eta={i})") for i in range(cells)])
    assert len(set(found)) == len(found) == cells


def test_line_styles_all_algorithms_with_variants_all_differ():
    algos = [*STYLES, "grid", "ab", "ba"]  # the last two have one style by their names
    assert line_style("ab") == line_style("ba")
    found = looks([(algo, f"{algo} ({i})") for algo in algos for i in range(12)])
    assert len(set(found)) == len(found)


def test_line_styles_first_series_has_the_style_of_its_algorithm():
    series = [("rnd", "rnd (eta=2)"), ("qrnd", "qrnd"), ("rnd", "rnd"), ("rnd", "rnd (eta=3)")]
    found = line_styles(series)
    for algo in ("rnd", "qrnd"):
        assert found[algo] == line_style(algo) | {"marker": ""}
    # The dashed line in the color of RND is QRND, so that no other series has it.
    orange = [style["linestyle"] for style in found.values() if style["color"] == "#E69F00"]
    assert sorted(orange) == sorted({"-", "--", ":", "-."})


def test_line_styles_many_variants_leave_the_style_of_an_algorithm_that_comes_later():
    series = [("ab", f"ab ({i})") for i in range(9)] + [("grid", "grid (a)"), ("grid", "grid (b)")]
    assert line_styles(series)["grid (a)"] == line_style("grid") | {"marker": ""}


def test_line_styles_no_series_has_the_style_of_another_algorithm():
    plain = {(line_style(algo)["color"], line_style(algo)["linestyle"], "") for algo in STYLES}
    assert not plain & set(looks([("grid", f"grid ({i})") for i in range(100)]))
    variants = looks([("ppo", f"ppo ({i})") for i in range(30)])
    assert plain & set(variants) == {("#000000", "-", "")}
