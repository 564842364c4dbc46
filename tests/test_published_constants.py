"""Hold every default to the table of published constants, published_constants.yaml."""

from inspect import Parameter, signature
from pathlib import Path

import pytest
import yaml

import sndjax
from experiments.config.compose import load_config
from experiments.config.schema import AlgoConfig, PPOConfig
from sndjax.grid import OBJECTIVES, SIGNALS
from sndjax.objectives.contrastive import TILES

TABLE = yaml.safe_load((Path(__file__).parent / "published_constants.yaml").read_text())
FAMILIES = TABLE["environments"]
ENVIRONMENTS = [(family, name) for family in FAMILIES for name in FAMILIES[family]["names"]]


def defaults(function):
    """Return the arguments of a function that have a default."""
    found = {n: p.default for n, p in signature(function).parameters.items()}
    return {n: v for n, v in found.items() if v is not Parameter.empty}


@pytest.mark.parametrize("kind", ["objectives", "signals", "losses"])
def test_constructors_and_losses_defaults_equal_the_table(kind):
    package = sndjax if kind == "losses" else getattr(sndjax, kind)
    for name, wanted in TABLE[kind].items():
        assert defaults(getattr(package, name)) == wanted, name
    if kind != "losses":
        known = set(OBJECTIVES) - {"none"} if kind == "objectives" else set(SIGNALS)
        assert set(TABLE[kind]) == known  # a new one needs a row


def test_augmentation_equals_the_table():
    assert TILES == (1, 2, 4, 8, 12, 16)


@pytest.mark.parametrize("name", list(OBJECTIVES))
def test_recipes_equal_the_table(name):
    recipe = OBJECTIVES[name]._asdict()
    assert (recipe.pop("objective") is None) == (name == "none")
    assert recipe == TABLE["recipes"][name]


def test_algorithms_equal_the_table():
    rows = {name: row for name, row in sndjax.ALGORITHMS.items() if row.objective is not None}
    assert set(rows) == set(TABLE["algorithms"])
    for name, (objective, signal, options, own, read) in TABLE["algorithms"].items():
        row = rows[name]
        plain = {k: list(v) if isinstance(v, tuple) else v for k, v in row.options.items()}
        assert (row.objective, row.signal, plain) == (objective, signal, options), name
        assert (dict(row.objective_options), dict(row.signal_options)) == (own, read), name


def test_icm_module_has_a_detached_target_and_the_published_weights():
    text = repr(sndjax.icm(5))
    assert "prediction(gradient='detached', " in text
    assert "weights=(0.8, 0.2)" in text
    assert "inverse_dynamics(last=1.0)" in text


def test_dataclasses_equal_the_table():
    hyper = sndjax.Hyperparameters()._asdict()
    assert hyper == TABLE["ppo"] | TABLE["ppo_others"]
    # The weight depends on how rewards are combined, the number of iterations on the run.
    for name in ("combine", "anneal_iterations"):
        hyper.pop(name)
    assert vars(PPOConfig()) == hyper | {"ext_weight": None, "anneal_learning_rate": False}
    module = sndjax.IntrinsicConfig(sndjax.rnd(3))._asdict()
    module.pop("module")
    assert module.pop("anneal_iterations") == 0
    assert module == TABLE["module"]
    assert {k: v for k, v in vars(AlgoConfig()).items() if k in TABLE["module"]} == TABLE["module"]
    assert sndjax.FrameStack()._asdict() == TABLE["stack"]


@pytest.mark.parametrize(("family", "name"), ENVIRONMENTS)
def test_load_config_environment_and_algorithm_equal_the_table(family, name):
    row = dict(FAMILIES[family])
    row.pop("names")
    for algo in TABLE["algorithms"]:
        config = load_config([f"env={name}", f"algo={algo}"])
        assert {key: getattr(config.env, key) for key in row} == row
        assert TABLE["ppo"].items() <= vars(config.ppo).items()
        assert config.network.name == "thesis"
        eta = TABLE["eta"][name].get(algo, TABLE["module"]["eta"])
        module = {key: getattr(config.algo, key) for key in TABLE["module"]}
        assert module == TABLE["module"] | {"eta": eta}, algo
        assert {key: getattr(config, key) for key in TABLE["run"]} == TABLE["run"]
        objective, signal, options, own, read = TABLE["algorithms"][algo]
        assert (config.algo.objective, config.algo.signal) == (objective, signal)
        assert config.algo.preprocess == options.get("preprocess", "none")
        assert own.items() <= config.objective.items()
        assert read.items() <= config.signal.items()
        weights = (config.algo.objective_weight, config.algo.signal_weight)
        assert weights == tuple(options.get("weights", (1, 1)))
    baseline = load_config([f"env={name}", "algo=ppo"])
    gamma = TABLE["baseline_gamma"].get(name, TABLE["baseline_gamma"]["other"])
    assert (baseline.ppo.gamma_ext, baseline.ppo.ext_weight) == (gamma, 1.0)
