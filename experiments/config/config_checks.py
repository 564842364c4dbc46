"""The check of a whole configuration: every field, every size and their combination."""

from collections.abc import Mapping
from dataclasses import Field, asdict
from typing import Any

from ..system.errors import ConfigError
from .cell_options import CELL_GROUPS, complete_config
from .library import algorithm_table, has_predictor
from .schema import Config, PPOConfig
from .validation import (
    check_range,
    config_options,
    get_option,
    group_choices,
    unknown_name_error,
)


def validate_config(config: Any, own: Mapping[str, Field[Any]] | None = None) -> Config:
    """Return a configuration with all its options, after a check of every field and size.

    Args:
      config: the configuration.
      own: see `complete_config`.

    Raises:
      ConfigError: a value or a combination is not allowed; the message names the first.
    """
    for name, entry in config_options():
        value = get_option(config, name)
        if isinstance(value, dict):
            for key, one in value.items() if name not in CELL_GROUPS else ():
                check_range(f"{name}.{key}", one, entry.metadata)
        else:
            for one in value if isinstance(value, list) else [value]:
                check_range(name, one, entry.metadata)
    check_algorithm_name(config)
    config = complete_config(config, own)
    check_minibatches(config)
    check_rewards(config)
    check_networks(config)
    check_without_effect(config)
    if config.algo.pairing != "asymmetric" and not has_predictor(config.algo.signal):
        raise ConfigError(f"algo.pairing: algo={config.algo.name} has no predictor network")
    if config.overlap and config.distributed:
        raise ConfigError("overlap=1 is for a run in one process, not for distributed=true")
    if config.seed + config.num_seeds > 2**31:
        raise ConfigError(f"seed={config.seed}: the last seed must be below 2**31")
    return config


def check_algorithm_name(config: Config) -> None:
    """Check that the algorithm exists and has the objective and the signal of its name.

    Raises:
      ConfigError: the algorithm is unknown, or its objective or its signal is another one.
    """
    algo = config.algo
    if algo.module is None and algo.name not in group_choices("algo"):
        raise unknown_name_error("algo", algo.name, group_choices("algo"))
    row = algorithm_table().get(algo.name) if algo.module is None else None
    if row is None or row.objective is None:
        return
    for what in ("objective", "signal"):
        given, own = getattr(algo, what), getattr(row, what)
        if given != own:
            raise ConfigError(
                f"algo.{what}={given}: algo={algo.name} is {own}; "
                "write algo=grid for another combination"
            )


def check_minibatches(config: Config) -> None:
    """Check that the minibatch sizes divide the rollout, and into sequences where that is needed.

    Raises:
      ConfigError: a minibatch size does not.
    """
    for name in ("ppo", "algo") if config.algo.name != "ppo" else ("ppo",):
        size = getattr(config, name).minibatch_size
        if config.rows % size:
            raise ConfigError(
                f"{name}.minibatch_size={size} does not divide the rollout, num_envs="
                f"{config.num_envs} x rollout_length={config.rollout_length} = {config.rows} rows"
            )


def check_rewards(config: Config) -> None:
    """Check that there is a reward to learn from, and no option for a missing reward.

    Raises:
      ConfigError: all rewards have weight 0, or an option does not fit the algorithm.
    """
    if config.algo.name == "ppo":
        if config.algo.eta != 0:
            raise ConfigError("algo.eta: algo=ppo has no intrinsic reward to scale")
        if config.ppo.ext_weight == 0:
            raise ConfigError(
                "ppo.ext_weight=0: with algo=ppo there is no other reward; "
                "choose an intrinsic algorithm"
            )
        if config.combine != "streams":
            raise ConfigError(f"combine={config.combine}: algo=ppo has no intrinsic reward")
    elif config.ppo.published_mask:
        raise ConfigError(
            "ppo.published_mask repeats the published baseline: use it only with algo=ppo"
        )
    elif config.ppo.ext_weight == config.ppo.int_weight == 0:
        raise ConfigError("ppo.ext_weight and ppo.int_weight are both 0: nothing to learn from")


def check_without_effect(config: Config) -> None:
    """Check that no option is given whose switch is off.

    Raises:
      ConfigError: there is one; the message names the switch.
    """
    ppo, algo = config.ppo, config.algo
    two_values = algo.name != "ppo" and config.combine == "streams"
    for name, given, switch, on in (
        (
            "ppo.normalize_over=minibatch",
            ppo.normalize_over != "rollout",
            "ppo.normalize_advantages=true",
            ppo.normalize_advantages,
        ),
        (
            "ppo.clip_int_value=false",
            not ppo.clip_int_value,
            "ppo.value_clip=VALUE and two values (combine=streams)",
            ppo.value_clip is not None and two_values,
        ),
        ("ppo.target_kl", ppo.target_kl is not None, "ppo.epochs=2 or more", ppo.epochs > 1),
        (
            "ppo.ext_weight or ppo.int_weight",
            config.combine == "product" and (ppo.ext_weight, ppo.int_weight) != (1, 1),
            "combine=streams or combine=sum",
            False,
        ),
        (
            f"algo.objective_weight={algo.objective_weight}",
            algo.objective_weight != 1 and algo.module is None,
            "an objective",
            algo.objective != "none",
        ),
        (
            f"ppo.ext_exponent={ppo.ext_exponent}",
            ppo.ext_exponent != PPOConfig().ext_exponent,
            "combine=product",
            config.combine == "product",
        ),
    ):
        if given and not on:
            raise ConfigError(f"{name} has no effect without {switch}")


def check_networks(config: Config) -> None:
    """Check the networks' options that need no observation; others are checked when there is one.

    Raises:
      ConfigError: there is no such network, or an option does not fit another.
    """
    network = config.network
    if network.name not in group_choices("network"):
        raise unknown_name_error("network", network.name, group_choices("network"))
    if "published" in (network.activation, network.policy.activation):
        raise ConfigError(
            "network.activation=published is for the module: network.module.activation=published; "
            "the published policy's is relu"
        )
    own = {name: value for name, value in asdict(network.module).items() if value is not None}
    if config.algo.name == "ppo" and own:
        raise ConfigError(f"network.module.{min(own)}: algo=ppo has no intrinsic module")
    size, steps = config.ppo.minibatch_size, config.rollout_length
    if network.memory != "none" and (size % steps or config.num_envs % (size // steps)):
        raise ConfigError(
            f"ppo.minibatch_size={size}: with network.memory={network.memory} a minibatch is whole "
            f"sequences: rollout_length={steps} times a divisor of num_envs={config.num_envs}"
        )
