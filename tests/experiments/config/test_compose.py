import dataclasses
import subprocess
import sys
from typing import get_args

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.config import compose as config
from experiments.config import schema as options
from experiments.config import validation as validate
from experiments.config.option_help import run_help
from experiments.config.schema import Config, PPOConfig
from experiments.system.errors import ConfigError
from sndjax import VECTOR, Hyperparameters, ppo
from sndjax.algorithms import NAMED
from sndjax.architectures import NETWORKS, Memory
from sndjax.grid import OBJECTIVES, SIGNALS, ModuleActivation, Pairing
from sndjax.preprocessing import Preprocess
from sndjax.scaling import RewardScale

VENTURE = ["env=Venture", "algo=snd_std"]

# The intrinsic scales that were published for each environment; 0.5 where the table is empty.
ALL = {"rnd": 1, "icm": 1, "sp": 1, "snd_v": 0.5, "qrnd": 0.5, "sp_vic": 0.5, "sp_vinv": 0.5}
ATARI = ALL | {"snd_vic": 0.25, "snd_vinv": 0.5, "snd_barlow": 0.5, "snd_byol": 0.5}
PROCGEN = ALL | {"snd_vic": 0.5, "snd_vinv": 0.5}
ETA = {
    "MontezumaRevenge": ATARI | {"snd_std": 1},
    "Gravitar": ATARI | {"snd_std": 1},
    "Venture": ATARI | {"snd_std": 0.25},
    "PrivateEye": ATARI | {"snd_std": 0.5},
    "Pitfall": ATARI | {"snd_std": 1},
    "Solaris": ATARI | {"snd_std": 0.5},
    "Climber": PROCGEN | {"snd_std": 1},
    "Caveflyer": PROCGEN | {"snd_std": 0.5},
    "Coinrun": PROCGEN | {"snd_std": 0.25},
    "Jumper": PROCGEN | {"snd_std": 1},
}


@pytest.mark.parametrize("env", ETA)
def test_load_config_each_environment_has_its_published_settings(env):
    atari = env in list(ETA)[:6]
    for algo, eta in ETA[env].items():
        made = config.load_config([f"env={env}", f"algo={algo}"])
        assert made.algo.eta == eta
        assert made.total_steps == (128_000_000 if atari else 64_000_000)
        assert made.env.id == (f"{env}-v5" if atari else f"{env}Exploration-v0")
        assert (made.env.stack, made.env.reward) == ((4, "sign") if atari else (2, "raw"))
        assert made.env.random_action == (0 if atari else 0.01)
        assert (made.ppo.gamma_ext, made.ppo.ext_weight) == (0.998, 2)
        assert made.algo.preprocess == ("mean" if algo in ("rnd", "qrnd") else "none")
        if made.algo.signal == "prediction":
            assert made.signal["gradient"] == ("detached" if algo == "icm" else "symmetric")
    baseline = config.load_config([f"env={env}", "algo=ppo"])
    assert baseline.ppo.gamma_ext == (0.998 if env == "Gravitar" else 0.99)
    assert baseline.ppo.ext_weight == 1


def test_load_config_default_is_the_configuration_of_the_thesis():
    made = config.load_config(VENTURE)
    assert (made.num_envs, made.rollout_length) == (128, 128)
    options = made.env.options
    assert options["repeat_action_probability"] == 0.25
    assert options["full_action_space"] is True
    assert options["max_episode_steps"] == 4500
    assert made.algo.learning_rate == made.ppo.learning_rate == 1e-4
    assert made.iterations == 7813  # 128M steps rounded up to whole iterations


def test_PPOConfig_defaults_equal_those_of_the_library():
    ours = {f.name: f.default for f in dataclasses.fields(PPOConfig)}
    theirs = Hyperparameters()._asdict()
    # How rewards are combined and how long a run is are not options of PPO alone.
    assert set(theirs) - set(ours) == {"combine", "anneal_iterations"}
    assert set(ours) - set(theirs) == {"anneal_learning_rate"}
    same = (set(ours) & set(theirs)) - {"ext_weight"}
    assert {name: ours[name] for name in same} == {name: theirs[name] for name in same}
    assert config.load_config(VENTURE).ppo.ext_weight == theirs["ext_weight"]
    summed = config.load_config([*VENTURE, "combine=sum"])
    assert summed.ppo.ext_weight == 1
    assert {*NAMED, "grid", "module"} == set(validate.group_choices("algo"))
    assert set(OBJECTIVES) == set(options.OBJECTIVES)
    assert set(SIGNALS) == set(options.SIGNALS)


def test_load_config_named_algorithm_records_its_objective_and_signal():
    for name in set(NAMED) - {"ppo"}:
        made = config.load_config(["env=Jumper", f"algo={name}"]).algo
        described = repr(NAMED[name](15, VECTOR))
        assert made.objective == "none" or f"objective={made.objective}(" in described
        assert f"signal={made.signal}(" in described
        assert f"preprocess='{made.preprocess}'" in described


def test_load_config_grid_takes_any_objective_and_signal():
    made = config.load_config(
        ["env=Venture", "algo=grid", "algo.objective=barlow_twins", "algo.signal=noveld"]
    )
    assert (made.algo.name, made.algo.eta) == ("grid", 0.5)
    assert (made.algo.objective, made.algo.signal) == ("barlow_twins", "noveld")


def test_load_config_options_override_every_field():
    made = config.load_config(
        [*VENTURE, "ppo.clip=0.2", "algo.eta=2", "seed=7", "env.options.frame_skip=2",
         "env.options.difficulty=1", "total_steps=1_000"]
    )  # fmt: skip
    assert (made.ppo.clip, made.algo.eta, made.seed, made.total_steps) == (0.2, 2.0, 7, 1000)
    assert made.env.options["frame_skip"] == 2
    assert made.env.options["difficulty"] == 1


def test_load_config_envpool_task_gets_the_settings_of_its_family():
    pong = config.load_config(["env=envpool", "env.id=Pong-v5", "algo=rnd"])
    assert (pong.env.name, pong.env.stack, pong.env.reward) == ("Pong-v5", 4, "sign")
    maze = config.load_config(["env=envpool", "env.id=MazeExploration-v0", "algo=rnd"])
    assert (maze.env.stack, maze.env.random_action) == (2, 0.01)
    pole = config.load_config(["env=envpool", "env.id=CartPole-v1", "algo=rnd"])
    assert (pole.env.stack, pole.env.reward, pole.env.options) == (1, "raw", {})


def test_load_config_preset_and_level_are_those_of_the_committed_table():
    made = config.load_config(["env=CoinrunEasy", "algo=snd_vic", "preset=laptop"])
    assert made.env.options == {"num_levels": 1, "start_level": 9}
    assert (made.env.stack, made.env.reward, made.env.random_action) == (1, "raw", 0.01)
    assert (made.algo.eta, made.algo.reward_scale) == (10, "running_std")
    assert (made.ppo.learning_rate, made.ppo.clip, made.ppo.episodic_int) == (5e-4, 0.2, False)
    assert not made.ppo.normalize_advantages


def test_option_words_are_those_that_the_library_knows():
    words = {name: entry.metadata["choices"] for name, entry in validate.config_options()}
    known = {
        "combine": ppo.Combine,
        "ppo.normalize_over": ppo.NormalizeOver,
        "algo.reward_scale": RewardScale,
        "algo.preprocess": Preprocess,
        "algo.pairing": Pairing,
        "network.activation": ModuleActivation,
        "network.memory": Memory,
    }
    for name, literal in known.items():
        assert words[name] == get_args(literal), name
    assert set(validate.group_choices("network")) == set(NETWORKS)


def test_load_config_preset_is_the_same_for_all_and_options_override_it():
    names = set(validate.group_choices("algo")) - {"ppo", "module", "grid"}
    load = lambda algo, *more: config.load_config(
        ["env=Jumper", f"algo={algo}", "preset=laptop", *more]
    )
    made = [load(name) for name in names]
    first = made[0]
    assert (first.network.name, first.num_envs, first.total_steps) == ("small", 32, 400_000)
    for other in made:
        assert (other.ppo, other.network, other.num_envs) == (first.ppo, first.network, 32)
        assert (other.algo.minibatch_size, other.total_steps) == (256, 400_000)
    baseline = load("ppo")
    assert (baseline.algo.eta, baseline.network.name, baseline.ppo.minibatch_size) == (
        0,
        "small",
        256,
    )
    assert load("snd_vic", "num_envs=8", "algo.eta=3").num_envs == 8
    assert load("snd_vic", "algo.eta=3").algo.eta == 3


REFUSED = [
    ([], "give env=NAME, one of: Caveflyer"),
    (["env=Venture"], "give algo=NAME, one of: grid, icm"),
    (["env=Ventur", "algo=rnd"], "did you mean Venture"),
    (["env=Venture", "algo=snd_vik"], "did you mean snd_vic"),
    (["env=envpool", "algo=rnd"], "needs a task"),
    (["env=envpool", "algo=rnd", "env.id=Pnog-v5"], "did you mean Pong-v5"),
    (["env=envpool", "algo=rnd", "env.id=Pendulum-v1"], "Pendulum-v1 has Box actions"),
    ([*VENTURE, "nun_envs=3"], "did you mean num_envs"),
    ([*VENTURE, "learning_rate=1e-3"], "ppo.learning_rate or algo.learning_rate"),
    ([*VENTURE, "num_envs=0"], "num_envs=0: must be at least 1"),
    ([*VENTURE, "algo.eta=-0.5"], "algo.eta=-0.5: must be at least 0"),
    ([*VENTURE, "algo.eta=nan"], "must be finite"),
    ([*VENTURE, "ppo.clip=0"], "ppo.clip=0.0: must be more than 0"),
    ([*VENTURE, "ppo.epochs=2.5"], "ppo.epochs"),
    ([*VENTURE, "ppo.epochs=many"], "ppo.epochs"),
    ([*VENTURE, "seed=null"], "seed"),
    ([*VENTURE, "seed=0,1"], "names several values"),
    ([*VENTURE, "seed=1", "seed=2"], "given twice"),
    ([*VENTURE, "seed"], "write key=value"),
    ([*VENTURE, "--config"], "write key=value"),
    ([*VENTURE, "~seed"], "write key=value"),
    ([*VENTURE, "env.name=../x"], "env.name"),
    ([*VENTURE, "algo.reward_scale=running"], "did you mean running_std"),
    ([*VENTURE, "ppo.minibatch_size=500"], "ppo.minibatch_size=500 does not divide the rollout"),
    ([*VENTURE, "algo.minibatch_size=500"], "algo.minibatch_size=500 does not divide"),
    ([*VENTURE, "resume=/nonexistent"], "there is no run"),
    (["env=Venture", "algo=ppo", "ppo.ext_weight=0"], "choose an intrinsic algorithm"),
    (["env=Venture", "algo=ppo", "algo.eta=1"], "no intrinsic reward"),
    (["env=Venture", "algo=ppo", "algo.signal=e3b"], "algo=ppo has no encoder"),
    ([*VENTURE, "algo.objective=vicreg"], "algo=snd_std has a fixed objective and signal"),
    (["env=Venture", "algo=grid", "algo.signal=e3b"], "needs both"),
    (
        ["env=Venture", "algo=grid", "algo.signal=novel", "algo.objective=byol"],
        "did you mean noveld",
    ),
    (["env=Venture", "algo=grid", "algo.signal=re3", "algo.objective=vic"], "did you mean vicreg"),
    (["env=Venture", "algo=icm", "algo.pairing=relu"], "no predictor network"),
    ([*VENTURE, "signal.gradient=detached"], "signal distillation has no such option"),
    ([*VENTURE, "ppo.normalize_over=minibatch"], "without ppo.normalize_advantages=true"),
    ([*VENTURE, "ppo.clip_int_value=false"], "without ppo.value_clip=VALUE"),
    ([*VENTURE, "ppo.value_clip=1", "combine=sum", "ppo.clip_int_value=false"], "two values"),
    ([*VENTURE, "ppo.target_kl=1", "ppo.epochs=1"], "without ppo.epochs=2 or more"),
    ([*VENTURE, "combine=product", "ppo.int_weight=5"], "combine=streams or combine=sum"),
    (["env=Venture", "algo=rnd", "algo.objective_weight=3"], "without an objective"),
    ([*VENTURE, "ppo.ext_exponent=0.5"], "without combine=product"),
    (["env=Venture", "algo=ppo", "combine=sum"], "algo=ppo has no intrinsic reward"),
    (["env=Venture", "algo=ppo", "network.module.features=8"], "algo=ppo has no intrinsic module"),
    ([*VENTURE, "ppo.published_mask=true"], "only with algo=ppo"),
    ([*VENTURE, "algo.module=x.py:f"], "goes with algo=module"),
    (["env=Venture", "algo=module"], "goes with algo=module"),
    (["env=Venture", "algo.module=x.py"], "write FILE.py:FUNCTION"),
    (["env=Venture", "algo.module=/no/x.py:f"], "there is no file /no/x.py"),
    (["env=gymnasium", "algo=rnd"], "env=gymnasium needs a task"),
    (["env=MiniGrid", "algo=rnd", "env.id=Pong-v5"], "env=MiniGrid is for MiniGrid-"),
    (["env=MiniGrid", "algo=rnd", "env.id=MiniGrid-X"], "unknown envpool task 'MiniGrid-X'"),
    (["env=MiniGrid", "algo=rnd"], "such as env.id=MiniGrid-DoorKey-8x8-v0"),
    (["env=Jumper", "algo=rnd", "preset=labtop"], "did you mean laptop"),
    ([*VENTURE, "network=tiny"], "network"),
    ([*VENTURE, "env.id=Pong-v5"], "env=Venture has a fixed task"),
    ([*VENTURE, "env.suite=gymnasium"], "env=Venture has a fixed task"),
    (["env=Venture", "algo=ppo", "algo.shuffle=true"], "algo.shuffle: algo=ppo has no intrinsic"),
    (["env=Venture", "algo=ppo", "ppo.int_weight=2"], "ppo.int_weight: algo=ppo has no intrinsic"),
    ([*VENTURE, "ppo.ext_weight=0", "ppo.int_weight=0"], "nothing to learn from"),
]


@pytest.mark.parametrize(("arguments", "words"), REFUSED, ids=lambda x: str(x)[-40:])
def test_load_config_bad_input_raises_one_helpful_line(arguments, words):
    with pytest.raises(ConfigError) as refusal:
        config.load_config(arguments)
    message = str(refusal.value)
    assert words in message
    assert "\n" not in message


TEXT = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=12)
KEYS = st.one_of(st.sampled_from([name for name, _ in validate.config_options()]), TEXT)
VALUES = st.one_of(
    TEXT,
    st.integers().map(str),
    st.floats().map(str),
    st.sampled_from(["null", "[]", "{}", "${x}", "true"]),
)


@settings(deadline=None, max_examples=150)
@given(st.lists(st.tuples(KEYS, VALUES), max_size=3))
def test_load_config_generated_input_raises_only_ConfigError(pairs):
    pairs = [(k, v) for k, v in pairs if k != "env.id"]
    try:
        made = config.load_config([*VENTURE, *(f"{k}={v}" for k, v in pairs)])
    except ConfigError:
        return
    assert isinstance(made, Config)


def test_run_help_names_every_environment_algorithm_and_option():
    text = run_help()
    names = [name for group in validate.ALL_GROUPS for name in validate.group_choices(group)]
    names += [name for name, _ in validate.config_options()]
    for name in names:
        assert f"  {name}" in text


def test_run_refused_input_imports_no_jax():
    code = """
import sys
from experiments.run import main
assert main(['env=Venture', 'algo=rnd', 'num_envs=0']) == 2
assert not {'jax', 'envpool', 'flax'} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], check=True)
