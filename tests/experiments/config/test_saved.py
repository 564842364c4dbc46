import dataclasses

import pytest

from experiments.config.compose import load_config
from experiments.config.run_settings import check_settings, run_settings
from experiments.config.saved import SavedConfig, read_saved, to_yaml
from experiments.system.errors import ConfigError

VENTURE = ["env=Venture", "algo=snd_std"]


def text_of(made):
    return to_yaml(SavedConfig(made, {"jax": "1.2.3"}))


def test_load_resumed_task_that_is_code_must_be_on_the_command_line(tmp_path):
    made = load_config(["env=gymnasium", "env.id=mine:Task-v0", "algo=rnd"])
    (tmp_path / "config.yaml").write_text(text_of(made))
    with pytest.raises(ConfigError, match="for safety repeat"):
        load_config([f"resume={tmp_path}"])
    assert load_config([f"resume={tmp_path}", "env.id=mine:Task-v0"]).env.id == "mine:Task-v0"


def test_load_resumed_user_module_must_be_on_the_command_line(tmp_path):
    code = tmp_path / "bonus.py"
    code.write_text("")
    made = load_config(["env=MountainCar", f"algo.module={code}:mine"])
    assert (made.algo.name, made.algo.module) == ("mine", f"{code}:mine")
    (tmp_path / "config.yaml").write_text(text_of(made))
    with pytest.raises(ConfigError, match="for safety repeat"):
        load_config([f"resume={tmp_path}"])
    again = load_config([f"resume={tmp_path}", f"algo.module={code}:mine"])
    assert again.algo.module == made.algo.module
    named = f"algo.module={code}:snd_vic"
    with pytest.raises(ConfigError, match="snd_vic is the name of an algorithm"):
        load_config(["env=MountainCar", named])
    with pytest.raises(ConfigError, match="not other"):
        load_config([f"resume={tmp_path}", "algo.module=other.py:mine"])


def test_load_resumed_stored_configuration_equals_the_original(tmp_path):
    made = load_config([*VENTURE, "seed=3", "algo.shuffle=true", "env.options.mode=1"])
    (tmp_path / "config.yaml").write_text(text_of(made))
    again = load_config([f"resume={tmp_path}"])
    directory = {"run_dir": str(tmp_path), "resume": str(tmp_path)}
    assert dataclasses.replace(made, **directory) == again
    assert load_config([f"resume={tmp_path}", "env=Venture", "seed=3", "algo.eta=0.25"]) == again
    with pytest.raises(ConfigError, match="leave preset out"):
        load_config([f"resume={tmp_path}", "preset=laptop"])
    for other, words in (("seed=4", "seed=3, not 4"), ("env=Pitfall", "env=Venture, not Pitfall")):
        with pytest.raises(ConfigError, match=words):
            load_config([f"resume={tmp_path}", other])


def test_check_settings_option_newer_than_the_file_takes_its_default():
    config = load_config(["env=Venture", "algo=rnd"])
    old = {name: value for name, value in run_settings(config).items() if name != "network.name"}
    check_settings(config, old)
    with pytest.raises(ValueError, match=r"network\.name was thesis, is small"):
        check_settings(load_config(["env=Venture", "algo=rnd", "network=small"]), old)
    with pytest.raises(ValueError, match=r"ppo\.clip was 0\.1, is 0\.2"):
        check_settings(load_config(["env=Venture", "algo=rnd", "ppo.clip=0.2"]), old)


@pytest.mark.parametrize(
    "text",
    ["", "[1, 2]", "env: 3", "seed: many", "a: !!python/object/apply:os.system [ls]", "{", "x: 1"],
)
def test_read_saved_file_without_a_configuration_is_refused(tmp_path, text):
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(ConfigError):
        load_config([f"resume={tmp_path}"])


@pytest.fixture
def run(tmp_path):
    """Return a directory that holds the configuration of a run."""
    made = load_config([*VENTURE, "seed=3", "total_steps=100000"])
    (tmp_path / "config.yaml").write_text(text_of(made))
    return tmp_path


def test_read_saved_stored_versions_are_returned(run):
    assert read_saved(run / "config.yaml").made_with == {"jax": "1.2.3"}


BOMB = "a: &a [1, 1]\nb: &b [*a, *a]\nc: [*b, *b]"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (BOMB, "has an alias"),
        ("seed: ${oc.env:HOME}", "reference"),
        ("made_with: 3", "made_with"),
        ("env: {name: a, id: b}\nalgo: {name: rnd}\nseed: -1", "at least 0"),
        ("env: {name: a, id: b, stack: 99}\nalgo: {name: rnd}", "at most 16"),
        ("[" * 5000, "cannot be read"),
        ("seed: !!bool x", "cannot be read"),
        ("seed: !!int ''", "cannot be read"),
        ("env: {name: a, id: b}\nalgo: {name: pqo}", "unknown algo 'pqo'"),
        ("ppo: {clip: .nan}\nenv: {name: a, id: b}\nalgo: {name: rnd}", "must be finite"),
    ],
)
def test_read_saved_foreign_file_is_plain_data_within_ranges(run, text, words):
    (run / "config.yaml").write_text(text)
    with pytest.raises(ConfigError, match=words):
        load_config([f"resume={run}"])


def test_load_resumed_total_steps_can_grow_but_not_shrink(run):
    assert load_config([f"resume={run}", "total_steps=200000"]).total_steps == 200000
    for value, words in (("1000", "not shortened"), ("many", "total_steps"), ("0", "at least 1")):
        with pytest.raises(ConfigError, match=words):
            load_config([f"resume={run}", f"total_steps={value}"])


def test_load_resumed_or_new_auto_starts_a_missing_run_and_resumes_an_existing_one(run, tmp_path):
    same = [*VENTURE, "seed=3", "total_steps=100000", "resume=auto"]
    begun = load_config([*same, f"run_dir={tmp_path / 'new'}"])
    assert (begun.resume, begun.run_dir) == (None, str(tmp_path / "new"))
    again = load_config([*same, f"run_dir={run}"])
    assert (again.resume, again.run_dir) == (str(run), str(run))
    more = [x.replace("100000", "200000") for x in same]
    assert load_config([*more, f"run_dir={run}"]).total_steps == 200000
    for other, words in (
        ([*same, "ppo.clip=0.2"], "ppo.clip=0.1, not 0.2"),
        ([x.replace("=3", "=4") for x in same], "seed=3, not 4"),
        ([x.replace("100000", "1000") for x in same], "not shortened"),
    ):
        with pytest.raises(ConfigError, match=words):
            load_config([*other, f"run_dir={run}"])
    with pytest.raises(ConfigError, match="needs run_dir"):
        load_config(same)


def test_load_repeated_run_gets_a_separate_directory(run):
    path = run / "config.yaml"
    again = load_config([f"repeat={path}"])
    assert again == dataclasses.replace(read_saved(path).config, repeat=str(path))
    assert (again.run_dir, again.resume) == (None, None)
    assert load_config([f"repeat={path}", "run_dir=other"]).run_dir == "other"
    for more, words in (
        ("seed=4", "seed=3, not 4"),
        ("total_steps=200000", "leave it out"),
        ("resume=auto", "repeat starts a new run"),
    ):
        with pytest.raises(ConfigError, match=words):
            load_config([f"repeat={path}", more])
    with pytest.raises(ConfigError, match="no such file"):
        load_config([f"repeat={run}"])


@pytest.mark.parametrize(("what", "other"), [("objective", "byol"), ("signal", "noveld")])
def test_load_resumed_other_objective_or_signal_is_refused(tmp_path, what, other):
    """Check that no configuration can name one algorithm and train another."""
    made = load_config(["env=MountainCar", "algo=snd_vic"])
    own = getattr(made.algo, what)
    changed = text_of(made).replace(f"  {what}: {own}", f"  {what}: {other}")
    assert changed != text_of(made)
    (tmp_path / "config.yaml").write_text(changed)
    with pytest.raises(ConfigError, match=f"algo.{what}={other}: algo=snd_vic is {own}"):
        load_config([f"resume={tmp_path}"])
