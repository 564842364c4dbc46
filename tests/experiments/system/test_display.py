from experiments.system.display import Progress, format_duration, format_number

LINE = {
    "step": 50,
    "steps_per_second": 1234.5,
    "last100_ext_return": None,
    "int_reward_mean": 0.0123,
    "int_reward_clipped": 0.5,
    "entropy": 1.5,
}


def test_elsewhere_than_on_a_terminal_there_is_one_plain_line_an_iteration(capsys):
    progress = Progress("title", 100, 0)
    progress.phase("learning", 60)
    progress.iteration(LINE)
    progress.close()
    title, line = capsys.readouterr().out.splitlines()
    assert title == "title"
    assert line.startswith("step 50 of 100  steps/s 1,23")
    assert "last-100 return -" in line
    assert "clipped 50%" in line


def test_the_display_shows_the_time_gone_against_the_estimate(monkeypatch):
    progress = Progress("title", 100, 0)
    now = progress.since
    monkeypatch.setattr("experiments.system.display.time.monotonic", lambda: now + 23)
    progress.phase("learning", 130)
    monkeypatch.setattr("experiments.system.display.time.monotonic", lambda: now + 46)
    assert next(iter(progress.render().columns[2].cells)) == "learning 0:23 of about 2:10"
    progress.within(0.5)
    assert next(iter(progress.render().columns[2].cells)) == "learning 0:23 (50%)"


def test_times_and_missing_figures():
    assert format_duration(59.6) == "1:00"
    assert format_duration(3725) == "1:02:05"
    assert format_number(None) == "-"
