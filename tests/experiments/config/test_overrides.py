import subprocess
from contextlib import suppress

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import example, given, settings
from hypothesis import strategies as st

from experiments.config.compose import load_config
from experiments.config.overrides import normalize_overrides, option_kinds, parse_overrides
from experiments.config.saved import SavedConfig, to_yaml
from experiments.config.validation import ALL_GROUPS
from experiments.run import main
from experiments.sweeps.jobs import expand_jobs
from experiments.system.errors import ConfigError

CAR = ["env=MountainCar", "algo=rnd"]
NUMBERS = [name for name, kind in option_kinds().items() if kind is int]
NESTED = ("[]", "[a]", "[1,2]", "[[a],b]", "{a:1}", "{a:[1]}", "{}", "[{a:1}]")
READER = OverridesParser.create()


def accepted(command):
    """Parse with Hydra alone, to see that a hint can be written as it is printed."""
    return [READER.parse_override(one) for one in command.split()]


@pytest.mark.parametrize("key", [*ALL_GROUPS, *option_kinds()])
@pytest.mark.parametrize("value", NESTED)
def test_parse_overrides_list_or_mapping_is_refused_with_what_to_write(key, value):
    if option_kinds().get(key) is dict and value.startswith("{"):
        parse_overrides([f"{key}={value}"])
        return
    if option_kinds().get(key) is list and value in ("[]", "[1,2]"):
        (made,) = parse_overrides([f"{key}={value}"]).values()
        assert made.value() == ([1, 2] if value == "[1,2]" else [])
        return
    with pytest.raises(ConfigError) as refusal:
        parse_overrides([f"{key}={value}"])
    message = str(refusal.value)
    assert message.startswith(f"{key}={value}: ")
    instead = "algo.eta=" if key == "env.eta" else f"{key}=" if "." not in value else key
    assert instead in message.partition(": ")[2] or f"{key}.NAME=" in message


@pytest.mark.parametrize(
    ("argument", "instead"),
    [
        ("algo=[rnd,ppo]", ["algo=rnd", "algo=rnd,ppo"]),
        ("env=[Venture]", ["env=Venture"]),
        ("preset=[laptop]", ["preset=laptop"]),
        ("seed=[0,9]", ["seed=0", "seed=0,9"]),
        ("ppo.clip=[0.1,0.2]", ["ppo.clip=0.1", "ppo.clip=0.1,0.2"]),
        ("algo.shuffle=[true]", ["algo.shuffle=true"]),
        ("run_dir=[a,b]", ["run_dir=a"]),
    ],
)
def test_parse_overrides_list_names_the_value_and_the_sweep_to_write(argument, instead):
    with pytest.raises(ConfigError) as refusal:
        parse_overrides([argument])
    advice = str(refusal.value).partition("give one value: ")[2]
    one, _, sweep = advice.partition(", or for a sweep -m ")
    assert [x for x in (one, sweep) if x] == instead
    for override in accepted(one):
        assert not isinstance(override.value(), list)
    for override in accepted(sweep):
        assert override.is_sweep_override()


@pytest.mark.parametrize("argument", ["algo=null", "env=null", "preset=null", "seed=null"])
def test_parse_overrides_null_is_refused_with_what_to_write(argument):
    key = argument.partition("=")[0]
    with pytest.raises(ConfigError, match=f"^{argument}: this is no value; give one value: {key}="):
        parse_overrides([argument])


@pytest.mark.parametrize(
    "arguments",
    [
        ["env=MountainCar", "algo=[rnd,ppo]"],
        ["env=MountainCar", "algo={a:1}"],
        ["env=[Venture]", "algo=rnd"],
        ["env=MountainCar", "algo=rnd", "preset=[laptop]"],
        ["env=3", "algo=rnd"],
        ["-m", "env=MountainCar", "algo=[rnd,ppo]"],
        ["-m", "env={a:1}", "algo=rnd"],
    ],
    ids=" ".join,
)
def test_run_group_of_another_kind_is_one_line_and_status_2(arguments, capfd):
    assert main(arguments) == 2
    out, err = capfd.readouterr()
    assert len(err.splitlines()) == 1, out + err
    assert err.startswith("sndjax: ")


@pytest.mark.parametrize("key", NUMBERS)
def test_parse_overrides_whole_number_written_as_a_float_is_that_number(key):
    for text, wanted in (("1e6", 10**6), ("1_000_000", 10**6), ("2.0", 2), ("'1e2'", 100)):
        value = parse_overrides([f"{key}={text}"])[key].value()
        assert (type(value), value) == (int, wanted)
    for text in ("2.5", "1e-3", "nan", "inf", "1e400", "many", "true"):
        with pytest.raises(ConfigError, match=f"^{key}={text}: must be a "):
            parse_overrides([f"{key}={text}"])


def test_load_config_whole_numbers_written_as_floats_fill_every_option():
    given = ["total_steps=1e6", "num_envs=1e2", "rollout_length=128.0", "env.stack=2.0", "seed=1e1"]
    made = load_config([*CAR, *given, "ppo.minibatch_size=1.28e3", "algo.minibatch_size=1.28e3"])
    plain = ["total_steps=1000000", "num_envs=100", "rollout_length=128", "env.stack=2", "seed=10"]
    assert made == load_config(
        [*CAR, *plain, "ppo.minibatch_size=1280", "algo.minibatch_size=1280"]
    )


def test_load_config_argument_of_the_task_written_with_an_exponent_is_whole():
    given = [f"env.options.{one}" for one in ("max_episode_steps=1e4", "speed=2.0", "noise=1e-3")]
    made = load_config([*CAR, *given]).env.options
    assert (type(made["max_episode_steps"]), made["max_episode_steps"]) == (int, 10_000)
    assert (type(made["speed"]), made["noise"]) == (float, 0.001)


def test_load_config_repeated_file_written_by_hand_may_have_whole_numbers_as_floats(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text(to_yaml(SavedConfig(load_config([*CAR, "total_steps=1_000_000"]), {})))
    text = path.read_text()
    for written in ("1e6", "1.0e+6", "1_000_000", "1000000.0"):
        path.write_text(
            text.replace("total_steps: 1000000\ncheck", f"total_steps: {written}\ncheck")
        )
        assert written in path.read_text()
        assert load_config([f"repeat={path}"]).total_steps == 10**6
    path.write_text(text.replace("epochs: 4", "epochs: 2.5"))
    with pytest.raises(ConfigError, match=r"ppo\.epochs"):
        load_config([f"repeat={path}"])


def test_expand_jobs_whole_numbers_written_as_floats_name_the_same_jobs():
    given = ["total_steps=1e5,2e5", "num_envs=32.0", "seed=0,1e1", "ppo.minibatch_size=128"]
    plain = ["total_steps=100000,200000", "num_envs=32", "seed=0,10", "ppo.minibatch_size=128"]
    first = expand_jobs([*CAR, *given, "algo.minibatch_size=128"])
    assert first == expand_jobs([*CAR, *plain, "algo.minibatch_size=128"])
    assert not any(job.problem for job in first)
    assert normalize_overrides(["seed=[", "x=1e5"]) == ["seed=[", "x=1e5"]


@pytest.mark.parametrize("text", ["007", "1e5", "1_000", "true", "0.50"])
def test_load_config_text_that_looks_like_a_number_stays_as_it_is_written(text):
    assert load_config([*CAR, f"run_dir={text}"]).run_dir == text


@pytest.mark.parametrize("text", ["a,b", "my(run", "é/x", "a{b", "'x"])
def test_parse_overrides_unquoted_path_is_refused_with_the_quoted_one(text):
    with pytest.raises(ConfigError) as refusal:
        parse_overrides([f"run_dir={text}"])
    advice = str(refusal.value).partition("in a shell write ")[2]
    advice = advice.removesuffix(")") if "several values" in str(refusal.value) else advice
    words = subprocess.run(["bash", "-c", f"printf %s {advice}"], capture_output=True, text=True)
    assert parse_overrides([words.stdout])["run_dir"].value() == text


WORDS = st.text(alphabet=" =,'\"\\${}[]()/.:-+%~#ab1e5_é\n", max_size=8)


@settings(deadline=None, max_examples=200)
@example("algo", "[rnd,ppo]")
@given(st.sampled_from([*ALL_GROUPS, *option_kinds()]), WORDS)
def test_parse_overrides_generated_values_raise_only_ConfigError(key, text):
    with suppress(ConfigError):
        assert [*parse_overrides([f"{key}={text}"])] == [key]
