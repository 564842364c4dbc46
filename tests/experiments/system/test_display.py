from experiments.system.display import Progress, format_duration, format_number

LINE = {
    "step": 50,
    "steps_per_second": 1234.5,
    "last100_ext_return": None,
    "int_reward_mean": 0.0123,
    "int_reward_clipped": 0.5,
    "entropy": 1.5,
}


def test_Progress_without_terminal_prints_one_line_per_iteration(capsys):
    progress = Progress("title", 100, 0)
    progress.phase("learning", 60)
    progress.iteration(LINE)
    progress.close()
    title, line = capsys.readouterr().out.splitlines()
    assert title == "title"
    assert line.startswith("step 50 of 100  steps/s 1,23")
    assert "last-100 return -" in line
    assert "clipped 50%" in line


def test_Progress_compilation_shows_elapsed_and_estimated_time(monkeypatch):
    progress = Progress("title", 100, 0)
    now = progress.since
    monkeypatch.setattr("experiments.system.display.time.monotonic", lambda: now + 23)
    progress.phase("learning", 130)
    monkeypatch.setattr("experiments.system.display.time.monotonic", lambda: now + 46)
    assert next(iter(progress.render().columns[2].cells)) == "learning 0:23 of about 2:10"
    progress.within(0.5)
    assert next(iter(progress.render().columns[2].cells)) == "learning 0:23 (50%)"


def test_format_duration_and_format_number_missing_figures_are_dashes():
    assert format_duration(59.6) == "1:00"
    assert format_duration(3725) == "1:02:05"
    assert format_number(None) == "-"
