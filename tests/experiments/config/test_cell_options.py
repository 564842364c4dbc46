"""The options of objectives, signals and modules on the command line."""

import dataclasses

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

import sndjax
from experiments.config.cell_options import library_options
from experiments.config.compose import load_config, register_configs
from experiments.config.config_checks import validate_config
from experiments.config.run_settings import check_settings, run_settings
from experiments.config.saved import SavedConfig, parse_saved, to_yaml
from experiments.config.validation import CONF
from experiments.storage.read_runs import differing_settings
from experiments.system.errors import ConfigError
from experiments.training.agents import make_intrinsic_config
from sndjax import VECTOR

CAR = ["env=MountainCar"]
GRID = [*CAR, "algo=grid", "algo.objective=vicreg", "algo.signal=noveld"]
MODULE = '''
import sndjax


def mine(num_actions, size, temperature: float = 0.5, rounds: int = 2):
    """Make it."""
    assert isinstance(rounds, int)
    vicreg = sndjax.vicreg(covariance_weight=temperature)
    return sndjax.make_module(vicreg, "distillation", num_actions, size)
'''


def module_text(arguments):
    return repr(make_intrinsic_config(load_config(arguments), 3, VECTOR).module)


def test_options_of_named_algorithms_and_cells_reach_the_constructors():
    text = module_text([*CAR, "algo=snd_vic", "objective.covariance_weight=0.1"])
    assert "vicreg(invariance_weight=1.0, variance_weight=1.0, covariance_weight=0.1)" in text
    text = module_text([*GRID, "signal.alpha=0.9", "signal.num_hash_bits=1e1"])
    assert "alpha=0.9" in text
    assert "num_hash_bits=10" in text
    text = module_text([*CAR, "algo=icm", "signal.gradient=symmetric", "algo.signal_weight=0.5"])
    assert "prediction(gradient='symmetric', " in text
    assert "weights=(0.8, 0.5)" in text


def test_options_may_be_given_as_a_mapping():
    config = load_config([*CAR, "algo=rnd", "signal={update_proportion: 0.5}"])
    assert config.signal["update_proportion"] == 0.5


def test_defaults_are_those_of_the_algorithm_and_of_the_objectives_experiments():
    assert load_config([*CAR, "algo=sp"]).objective["spread_weight"] == 0.0
    assert load_config([*CAR, "algo=snd_std"]).signal["loss_reduction"] == "sum"
    assert load_config([*CAR, "algo=icm"]).signal["gradient"] == "detached"
    cell = [*CAR, "algo=grid", "algo.objective=none", "algo.signal=prediction"]
    assert load_config(cell).signal["reward_reduction"] == "tanh_mean"
    rnd = load_config([*CAR, "algo=rnd"]).signal
    assert (rnd["reward_reduction"], rnd["update_proportion"]) == ("half_sum", 0.25)
    for algo in ("rnd", "snd_std", "snd_vinv", "sp", "icm", "snd_byol"):
        plain = module_text([*CAR, f"algo={algo}"])
        named = getattr(sndjax, algo)(3, VECTOR)
        assert plain == repr(named), algo


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["algo=snd_vic", "objective.nu=1"], "vicreg has no such option; it has objective.inv"),
        (["algo=rnd", "objective.nu=1"], "objective none has no options"),
        (["algo=ppo", "signal.alpha=1"], "algo=ppo has no signal"),
        (["algo=rnd", "module.x=1"], "algo=rnd has no module"),
        (["algo=rnd", "signal.update_proportion=0"], "must be more than 0"),
        (["algo=rnd", "signal.update_proportion=1.5"], "must be at most 1"),
        (["algo=rnd", "signal.update_proportion=half"], "must be a number"),
        (["algo=rnd", "signal.loss_reduction=max"], "did you mean mean?"),
        (["algo=rnd", "signal.update_proportion=[1]"], "must be a number"),
        (["algo=rnd", "signal.update_proportion=true"], "must be a number"),
        (["algo=rnd", "signal.update_proportion=null"], "give a value"),
        (["algo=rnd", "signal=[1]"], "write signal.NAME=VALUE"),
        (["algo=rnd", "algo.gradient=detached"], "here it is signal.gradient"),
        (["algo=rnd", "algo.activation=relu"], "here it is network.module.activation"),
        (["algo=rnd", "covariance_weight=1"], "did you mean objective.covariance_weight"),
        ([*GRID[1:], "signal.num_hash_bits=2.5"], "must be a whole number"),
        ([*GRID[1:], "signal.centre=1"], "must be true or false"),
    ],
)  # fmt: skip
def test_unknown_and_impossible_options_are_refused_with_what_there_is(arguments, words):
    with pytest.raises(ConfigError) as refused:
        load_config([*CAR, *arguments])
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


def test_options_are_stored_whole_and_a_stored_run_resumes_with_them(tmp_path):
    config = load_config([*GRID, "signal.alpha=0.9", "network.hidden=[8,8]"])
    text = to_yaml(SavedConfig(config, {}))
    assert parse_saved(text, "here").config == dataclasses.replace(config)
    (tmp_path / "config.yaml").write_text(text)
    again = load_config([f"resume={tmp_path}", "signal.alpha=0.9"])
    assert again.signal == config.signal
    with pytest.raises(ConfigError, match=r"signal\.alpha=0\.9, not 0\.8"):
        load_config([f"resume={tmp_path}", "signal.alpha=0.8"])


def test_configurations_of_earlier_versions_keep_their_meaning():
    body = """
env: {name: MountainCar, id: MountainCar-v0}
algo: {name: icm, objective: inverse_dynamics, signal: prediction, gradient: symmetric,
  activation: published}
network: small
ppo: {ext_weight: 2.0}
"""
    config = parse_saved(body, "here").config
    assert config.signal["gradient"] == "symmetric"
    assert config.network.name == "small"
    assert config.network.module.activation == "published"
    assert (config.algo.objective_weight, config.algo.signal_weight) == (0.8, 0.2)
    # The settings in a checkpoint of that version are the same run.
    settings = run_settings(config)
    old = {k: v for k, v in settings.items() if not k.startswith(("network.", "signal.", "obj"))}
    old |= {"network": "small", "algo.gradient": "symmetric", "algo.activation": "published"}
    old.pop("algo.objective_weight")
    old.pop("algo.signal_weight")
    check_settings(config, old)
    with pytest.raises(ValueError, match=r"signal\.gradient was detached, is symmetric"):
        check_settings(config, old | {"algo.gradient": "detached"})


def test_options_of_a_users_function_reach_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my.py").write_text(MODULE)
    arguments = [*CAR, "algo.module=my.py:mine"]
    assert load_config(arguments).module == {"temperature": 0.5, "rounds": 2}
    assert "covariance_weight=0.25" in module_text([*arguments, "module.temperature=0.25"])
    with pytest.raises(ConfigError, match=r"my\.py:mine has no such option; it has module\.temp"):
        load_config([*arguments, "module.heat=1"])
    with pytest.raises(ConfigError, match="has no signal"):
        load_config([*arguments, "signal.alpha=1"])


def test_stored_configurations_do_not_read_the_file_that_they_name(tmp_path):
    """A huge number, and a file that is gone: neither stops a report."""
    body = "env: {name: MountainCar, id: MountainCar-v0}\nalgo: {name: mine, module: %s}\n"
    text = body % (tmp_path / "gone.py:mine") + "module: {heat: 2.0}\n"
    assert validate_config(parse_saved(text, "here").config).module == {"heat": 2.0}
    text = "env: {name: MountainCar, id: MountainCar-v0}\nalgo: {name: rnd}\n"
    text += "signal: {update_proportion: 1%s}\n" % ("0" * 400)
    with pytest.raises(ConfigError, match="must be a number"):
        validate_config(parse_saved(text, "here").config)


def test_differing_settings_names_options_that_differ_where_both_have_them():
    configs = [
        load_config([*CAR, "algo=grid", "algo.objective=none", *more])
        for more in (
            ["algo.signal=noveld", "signal.alpha=0.5"],
            ["algo.signal=noveld", "signal.alpha=0.9", "network.hidden=[8]"],
            ["algo.signal=re3"],
        )
    ]
    assert differing_settings(configs) == ["algo.signal", "network.hidden", "signal.alpha"]
    cells = [
        load_config([*CAR, "algo=grid", f"algo.objective={name}", "algo.signal=noveld"])
        for name in ("none", "vicreg", "st_dim")
    ]
    assert differing_settings(cells) == ["algo.objective"]  # reductions follow the objective
    same = [load_config([*GRID, "signal.alpha=0.9", f"network.hidden=[{n}]"]) for n in (8, 9)]
    assert differing_settings(same) == ["network.hidden"]


def test_every_option_of_a_constructor_is_one_that_a_search_may_set():
    names = sorted(library_options())
    assert len(names) > 30
    register_configs()
    given = ["env=MountainCar", "algo=rnd", *(f"{name}=1" for name in names)]
    with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        made = compose("multirun", overrides=given)
    assert all(OmegaConf.select(made, name) == 1 for name in names)
