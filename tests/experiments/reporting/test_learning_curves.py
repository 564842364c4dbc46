import csv

import numpy as np
import pytest
from helpers.run_files import made

from experiments.reporting import learning_curves
from experiments.reporting.learning_curves import QUANTITIES, curve_notes, draw_curves
from experiments.storage.read_runs import find_runs, group_runs

CAR = ["env=MountainCar", "algo=rnd"]


@pytest.fixture
def figures(monkeypatch):
    """Return the figures that are saved."""
    found = []
    save = learning_curves.save_figure
    keep = lambda figure, *rest, **of: found.append(figure) or save(figure, *rest, **of)
    monkeypatch.setattr(learning_curves, "save_figure", keep)
    return found


def run(path, steps, arguments=CAR, seed=0, value=1.0):
    """Write a run with an episode every 100 steps, all of one return."""
    episodes = [(step, value, value) for step in range(100, steps + 1, 100)]
    novelty = {seed: [0.5] * (steps // 100)}
    return made(path, [*arguments, f"seed={seed}"], {seed: episodes}, novelty, rows=100)


def groups_in(place):
    return group_runs(find_runs([place])[0])


def lines_of(figure):
    """Return the lines of a figure without its legend, the bold ones and the thin ones."""
    (axes,) = figure.axes
    lines = [line for line in axes.lines if line.get_linestyle() != "None"]
    bold = [line for line in lines if line.get_linewidth() > 1]
    return bold, [line for line in lines if line.get_linewidth() <= 1]


def marks_of(figure, marker):
    (axes,) = figure.axes
    marks = [line for line in axes.lines if line.get_linestyle() == "None"]
    return [x for line in marks if line.get_marker() == marker for x in line.get_xdata()]


def legend_of(figure):
    (axes,) = figure.axes
    return [text.get_text() for text in axes.get_legend().get_texts()]


def test_draw_curves_seed_that_ends_early_is_marked_and_the_mean_continues(tmp_path, figures):
    run(tmp_path / "long", 57_700, value=0.92)
    run(tmp_path / "short", 1_600, seed=1, value=0.0)
    groups = groups_in(tmp_path)
    draw_curves(groups, "return", "title", tmp_path, "curve")
    ((mean,), thin) = lines_of(figures[0])
    assert mean.get_xdata()[-1] == 57_700
    assert mean.get_ydata()[-1] == pytest.approx(0.92)
    assert mean.get_ydata()[0] == pytest.approx(0.46)
    assert len(thin) == 2
    assert marks_of(figures[0], "X") == [1_600]
    assert "a seed ends: the mean is over fewer" in legend_of(figures[0])
    assert curve_notes(groups) == "RND: its seeds end at 0.0016 and 0.0577 million steps."
    with (tmp_path / "curve.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["seeds"] for row in rows if float(row["step"]) <= 1_600} == {"2"}
    assert {row["seeds"] for row in rows if float(row["step"]) > 1_600} == {"1"}
    assert {row["low"] for row in rows if float(row["step"]) > 1_600} == {""}


def test_draw_curves_seed_whose_first_episode_is_late_is_marked(tmp_path, figures):
    run(tmp_path / "early", 1_000)
    late = {1: [(700, 0.0, 0.0)]}
    made(tmp_path / "late", [*CAR, "seed=1"], late, {1: [0.5] * 10}, rows=100)
    draw_curves(groups_in(tmp_path), "return", "title", tmp_path, "curve")
    ((mean,), _) = lines_of(figures[0])
    assert (mean.get_xdata()[0], mean.get_xdata()[-1]) == (100, 1_000)
    assert marks_of(figures[0], "|") == [700]
    assert marks_of(figures[0], "X") == []  # both were trained until step 1,000


def test_draw_curves_seeds_of_equal_length_have_no_marks(tmp_path, figures):
    run(tmp_path / "a", 1_000)
    run(tmp_path / "b", 1_000, seed=1)
    groups = groups_in(tmp_path)
    draw_curves(groups, "return", "title", tmp_path, "curve")
    assert marks_of(figures[0], "X") + marks_of(figures[0], "|") == []
    assert legend_of(figures[0]) == ["RND, 2 seeds", "one seed"]
    assert curve_notes(groups) == ""


def test_draw_curves_one_seed_is_drawn_as_the_steps_of_its_values(tmp_path, figures):
    draw = np.random.default_rng(0)
    episodes = [(100 * (i + 1), *2 * [float(draw.random())]) for i in range(50)]
    made(tmp_path / "a", CAR, {0: episodes}, {0: [0.5] * 50}, rows=100)
    groups = groups_in(tmp_path)
    draw_curves(groups, "return", "title", tmp_path, "curve")
    ((mean,), thin) = lines_of(figures[0])
    steps, values = QUANTITIES["return"].of(groups[0].seeds[0])
    np.testing.assert_array_equal(mean.get_xdata(), steps)
    np.testing.assert_array_equal(mean.get_ydata(), values)
    assert mean.get_drawstyle() == "steps-post"
    assert thin == []  # it is the mean


def test_draw_curves_mean_and_seeds_are_drawn_by_one_rule(tmp_path, figures):
    run(tmp_path / "a", 1_000, value=0.25)
    run(tmp_path / "b", 1_000, seed=1, value=0.75)
    draw_curves(groups_in(tmp_path), "return", "title", tmp_path, "curve")
    ((mean,), (one, two)) = lines_of(figures[0])
    assert {line.get_drawstyle() for line in (mean, one, two)} == {"steps-post"}
    for line in (one, two):
        np.testing.assert_array_equal(line.get_xdata(), mean.get_xdata())
    both = np.mean([one.get_ydata(), two.get_ydata()], axis=0)
    np.testing.assert_allclose(mean.get_ydata(), both)


def test_draw_curves_repeated_run_is_shown_and_not_in_the_mean(tmp_path, figures):
    run(tmp_path / "first", 2_000, value=1.0)
    run(tmp_path / "other", 2_000, seed=1, value=0.0)
    run(tmp_path / "again", 1_500, value=0.5)
    groups = groups_in(tmp_path)
    draw_curves(groups, "return", "title", tmp_path, "curve")
    ((mean,), thin) = lines_of(figures[0])
    np.testing.assert_allclose(mean.get_ydata(), 0.5)  # of 1 and 0
    (repeat,) = [line for line in thin if line.get_marker() == "o"]
    shown = np.isfinite(repeat.get_ydata())
    assert repeat.get_xdata()[shown][-1] == 1_500
    np.testing.assert_allclose(repeat.get_ydata()[shown], 0.5)
    assert len(thin) == 3
    assert "RND, 2 seeds and 1 repeat" in legend_of(figures[0])
    assert "a repeated run, not in the mean" in legend_of(figures[0])
    assert curve_notes(groups) == "RND: repeated runs of seed 0, which the mean leaves out."


def test_draw_curves_nine_cells_have_nine_looks_and_nine_labels(tmp_path, figures):
    for objective in ("none", "vicreg", "st_dim"):
        for signal in ("distillation", "noveld", "ngu"):
            cell = ["algo=grid", f"algo.objective={objective}", f"algo.signal={signal}"]
            run(tmp_path / objective / signal, 300, ["env=MountainCar", *cell])
    draw_curves(groups_in(tmp_path), "return", "title", tmp_path, "curve")
    bold, _ = lines_of(figures[0])
    looks = {(line.get_color(), line.get_linestyle(), line.get_marker()) for line in bold}
    assert len(looks) == len(bold) == len(set(legend_of(figures[0]))) == 9


def test_draw_curves_return_that_is_not_finite_does_not_end_the_curve(tmp_path, figures):
    episodes = [(100, 0.0, 0.0), (200, float("nan"), 0.0), (300, 1.0, 0.0)]
    made(tmp_path / "a", CAR, {0: episodes}, {0: [0.5] * 3}, rows=100)
    draw_curves(groups_in(tmp_path), "return", "title", tmp_path, "curve")
    ((mean,), _) = lines_of(figures[0])
    np.testing.assert_array_equal(mean.get_xdata(), [100, 300])
    np.testing.assert_allclose(mean.get_ydata(), [0.0, 0.01])


def test_curve_notes_many_seeds_says_that_single_seeds_are_not_drawn(tmp_path, figures):
    for seed in range(11):
        run(tmp_path / str(seed), 200 + 100 * seed, seed=seed)
    groups = groups_in(tmp_path)
    draw_curves(groups, "return", "title", tmp_path, "curve")
    assert len(lines_of(figures[0])[1]) == 0
    assert marks_of(figures[0], "X") == [200 + 100 * seed for seed in range(10)]
    assert curve_notes(groups).splitlines() == [
        "RND: its seeds end at 0.0002 to 0.0012 million steps.",
        "Single seeds and repeats are not drawn, because there are many: all.",
    ]


def test_draw_curves_many_groups_have_no_thin_lines_and_the_note_says_so(tmp_path, figures):
    one = run(tmp_path / "0", 200)
    groups = groups_in(one)
    many = [groups[0]._replace(name=f"rnd (eta={i})", seeds=groups[0].seeds * 2) for i in range(51)]
    draw_curves(many, "return", "title", tmp_path, "curve")
    draw_curves(many[:50], "return", "title", tmp_path, "fewer")
    assert [len(lines_of(figure)[1]) for figure in figures] == [0, 100]
    assert len(legend_of(figures[0])) == 51
    assert curve_notes(many) == (
        "Single seeds and repeats are not drawn, because there are many: all."
    )
    assert curve_notes(many[:50]) == ""
