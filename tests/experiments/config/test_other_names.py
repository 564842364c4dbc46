from dataclasses import fields

import pytest

from experiments import evaluate, record
from experiments.config.cell_options import library_options
from experiments.config.other_names import OTHER_NAMES
from experiments.config.overrides import parse_overrides
from experiments.config.tool_options import parse_arguments
from experiments.config.validation import ALL_GROUPS, config_options
from experiments.system.errors import ConfigError

RUN = {*ALL_GROUPS, *(name for name, _ in config_options()), *library_options()}
TOOLS = {entry.name for tool in (evaluate, record) for entry in fields(tool.Options)}

# Names in CleanRL's, Stable-Baselines3's and PureJaxRL's scripts, and what they are here.
KNOWN = {
    "lr": "ppo.learning_rate",
    "ppo.lr": "ppo.learning_rate",
    "algo.lr": "algo.learning_rate",
    "ent_coef": "ppo.entropy_weight",
    "vf_coef": "ppo.value_weight",
    "clip_eps": "ppo.clip",
    "clip_coef": "ppo.clip",
    "clip_range": "ppo.clip",
    "n_steps": "rollout_length",
    "num_steps": "rollout_length",
    "n_envs": "num_envs",
    "gamma": "ppo.gamma_ext",
    "gae_lambda": "ppo.gae_lambda",
    "max_grad_norm": "ppo.max_grad_norm",
    "update_epochs": "ppo.epochs",
    "n_epochs": "ppo.epochs",
    "num_minibatches": "ppo.minibatch_size",
    "batch_size": "ppo.minibatch_size",
    "total_timesteps": "total_steps",
    "TOTAL_TIMESTEPS": "total_steps",
    "total-timesteps": "total_steps",
    "seeds": "num_seeds",
    "env_id": "env",
    "int_coef": "ppo.int_weight",
    "ext_coef": "ppo.ext_weight",
}


def test_OTHER_NAMES_every_target_is_an_option():
    for name, hint in OTHER_NAMES.items():
        assert hint.options, name
        assert {*hint.options} <= RUN or {*hint.options} <= TOOLS, name


def test_OTHER_NAMES_no_name_is_an_option_of_a_run_itself():
    assert not {*OTHER_NAMES} & RUN


@pytest.mark.parametrize("name", KNOWN)
def test_parse_overrides_name_of_another_library_names_ours_first(name):
    with pytest.raises(ConfigError) as refusal:
        parse_overrides([f"{name}=1"])
    assert str(refusal.value).startswith(f"unknown option '{name}'; here it is {KNOWN[name]}")


def test_parse_overrides_group_of_the_other_name_chooses_among_ours():
    with pytest.raises(ConfigError) as refusal:
        parse_overrides(["algo.lr=1"])
    assert "ppo" not in str(refusal.value)


def test_parse_arguments_name_of_another_library_names_the_option_of_the_tool():
    with pytest.raises(ConfigError, match="here it is episodes"):
        parse_arguments(["runs/x", "n_eval_episodes=5"], evaluate.Options)
    with pytest.raises(ConfigError, match="unknown option 'lr'; known: "):
        parse_arguments(["runs/x", "lr=5"], evaluate.Options)  # not an option of this tool
