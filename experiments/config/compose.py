"""Composition of a validated `Config` from the command line, without importing jax."""

from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ..system.errors import ConfigError
from .cell_options import library_options, module_options
from .config_checks import validate_config
from .earlier_options import loss_weights
from .jax_suites import JAX_SUITES, check_installed
from .library import algorithm_table
from .overrides import FREE_OPTIONS, parse_argument, parse_overrides
from .saved import config_schema, innermost_reason, load_repeated, load_resumed, load_resumed_or_new
from .schema import OBJECTIVES, Config
from .user_function import split_reference
from .validation import (
    CONF,
    GENERIC_ENVS,
    GROUPS,
    OTHER_SUITES,
    group_choices,
)

FOR = "# for: "  # begins the line of a preset that names its algorithm


def load_config(arguments: list[str]) -> Config:
    """Return the configuration that the command line asks for.

    Raises:
      ConfigError: the command line is invalid; one line says what is wrong and what is right.
    """
    overrides = parse_overrides(arguments)
    for key in ("resume", "repeat"):
        if key in overrides and overrides[key].value() is None:
            del overrides[key]
    if "repeat" in overrides:
        return load_repeated(overrides)
    if "resume" in overrides and overrides["resume"].value() != "auto":
        return load_resumed(overrides)
    config = compose_config(overrides)
    return load_resumed_or_new(config) if config.resume == "auto" else config


def compose_config(overrides: dict[str, Override]) -> Config:
    """Return the configuration that Hydra composes from the groups and the options.

    Raises:
      ConfigError: a group is not named, or the options do not fit together.
    """
    if "algo.module" in overrides:
        overrides.setdefault("algo", OverridesParser.create().parse_override("algo=module"))
    if "preset" in overrides and "algo" not in overrides:
        for argument in preset_arguments(str(overrides["preset"].value())):
            overrides.setdefault(argument.partition("=")[0], parse_argument(argument))
    for group in GROUPS:
        if group not in overrides:
            names = ", ".join(group_choices(group))
            raise ConfigError(f"give {group}=NAME, one of: {names} (--help explains them)")
    check_algorithm(overrides)
    lines = [override_line(override) for override in overrides.values()]
    lines += task_lines(overrides)
    if "algo.module" in overrides:
        lines.append(f"algo.name={module_name(str(overrides['algo.module'].value()))}")
    register_configs()
    try:
        with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
            config = OmegaConf.to_object(compose("config", overrides=lines))
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(innermost_reason(error)) from None
    assert isinstance(config, Config)
    return validate_config(config, module_options(config.algo))


def preset_arguments(name: str) -> list[str]:
    """Return the algorithm of a preset, as arguments: the line `# for: ...` in its file.

    >>> preset_arguments("laptop")
    []
    """
    lines = (CONF / "preset" / f"{name}.yaml").read_text().splitlines()
    return [
        word for line in lines if line.startswith(FOR) for word in line.removeprefix(FOR).split()
    ]


def register_configs() -> None:
    """Register with Hydra the schema and the configuration of each algorithm in the table.

    A search sets only options that Hydra knows: `constructor_options` names those of objectives and
    signals for it.
    """
    store = ConfigStore.instance()
    store.store(name="schema", node=config_schema())
    names: dict[str, dict[str, None]] = {"objective": {}, "signal": {}}
    for option in library_options():
        group, _, name = option.partition(".")
        names[group][name] = None
    store.store(name="constructor_options", node=names)
    for name, row in algorithm_table().items():
        if row.objective is not None:  # the baseline is configured in conf/algo/ppo.yaml
            store.store(group="algo", name=name, node=algorithm_node(name))


def algorithm_node(name: str) -> dict[str, Any]:
    """Return the configuration of an algorithm in the table, for the group `algo`."""
    row = algorithm_table()[name]
    return {
        "name": name,
        "objective": row.objective,
        "signal": row.signal,
        "eta": f"${{oc.select:env.eta.{name},${{oc.select:env.eta.other,0.5}}}}",
        "preprocess": row.options.get("preprocess", "none"),
        **loss_weights(row),
    }


def task_lines(overrides: dict[str, Override]) -> list[str]:
    """Return the overrides that follow from the task that `env.id` names.

    Raises:
      ConfigError: the environment has a fixed task, needs a task, or does not accept this one.
    """
    env = str(overrides["env"].value())
    if env in GENERIC_ENVS and "env.id" not in overrides:
        raise ConfigError(f"env={env} needs a task, such as env.id={GENERIC_ENVS[env]}")
    suite = str(overrides["env.suite"].value()) if "env.suite" in overrides else None
    given = {"env.id": env not in GENERIC_ENVS and "env.id" in overrides}
    given["env.suite"] = suite is not None and suite not in known_suites(env)
    for key in [key for key, wrong in given.items() if wrong]:
        raise ConfigError(f"{key}: env={env} has a fixed task; use env=envpool or env=gymnasium")
    check_installed(suite or env)
    task = str(overrides["env.id"].value()) if "env.id" in overrides else ""
    of_module = env == "MiniGrid" and ":" in task  # minigrid's task, made by gymnasium
    if env == "MiniGrid" and not task.rpartition(":")[2].startswith("MiniGrid-"):
        raise ConfigError(
            f"env.id={task}: env=MiniGrid is for MiniGrid-... and minigrid:MiniGrid-..."
        )
    lines = []
    if of_module and "env.suite" not in overrides:
        lines.append("env.suite=gymnasium")
    if env == "jax":
        split_reference("env.id", task)
    if task and env in ("envpool", "MiniGrid") and not of_module:
        from .envpool_tasks import family_of  # imports envpool

        family = family_of(task)
        if env == "envpool":
            lines.append(f"family@env={family}")
    return lines


def known_suites(env: str) -> tuple[str, ...]:
    """Return the suites that `env.suite=` may name for an environment."""
    if env in JAX_SUITES:
        return (env,)
    return OTHER_SUITES.get(env, ("envpool", "gymnasium") if env in GENERIC_ENVS else ())


def check_algorithm(overrides: dict[str, Override]) -> None:
    """Check that the options of the objective, signal and module fit the named algorithm.

    Raises:
      ConfigError: an option does not fit the algorithm, or a required one is missing.
    """
    algo = str(overrides["algo"].value())
    given = [k for k in ("algo.objective", "algo.signal") if k in overrides]
    if given and algo == "ppo":
        known = ", ".join(OBJECTIVES)
        raise ConfigError(
            f"{given[0]}: algo=ppo has no encoder; use algo=grid "
            f"algo.objective=NAME algo.signal=NAME; objectives: {known}"
        )
    unused = {"ppo.int_weight", "ppo.gamma_int", "ppo.episodic_int"}
    unused |= {k for k in overrides if k.startswith("algo.")} - {"algo.eta"}
    if algo == "ppo" and unused & set(overrides):
        raise ConfigError(f"{min(unused & set(overrides))}: algo=ppo has no intrinsic reward")
    if given and algo != "grid":
        raise ConfigError(
            f"{given[0]}: algo={algo} has a fixed objective and signal; use algo=grid"
        )
    if algo == "grid" and len(given) < 2:
        raise ConfigError("algo=grid needs both algo.objective=NAME and algo.signal=NAME")
    if (algo == "module") != ("algo.module" in overrides):
        raise ConfigError("algo.module=FILE.py:FUNCTION goes with algo=module, and it with that")
    if algo == "module":
        for key in ("preprocess", "pairing", "objective_weight", "signal_weight"):
            if f"algo.{key}" in overrides:
                raise ConfigError(f"algo.{key}: set it inside the function that algo.module names")


def module_name(reference: str) -> str:
    """Return the name of the algorithm that FILE.py:FUNCTION makes: that of the function.

    Raises:
      ConfigError: the text has another form, the file does not exist, or the name is that of an
        algorithm.
    """
    _, name = split_reference("algo.module", reference)
    if name in group_choices("algo"):
        raise ConfigError(
            f"algo.module={reference}: {name} is the name of an algorithm; choose another name"
        )
    return name


def override_line(override: Override) -> str:
    """Return the override in Hydra's syntax; keys of free options may be new."""
    assert override.input_line is not None
    text = override.input_line.lstrip("+")
    free = f"{override.key_or_group}.".startswith(FREE_OPTIONS)
    return f"++{text}" if free else text
