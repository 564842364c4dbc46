"""The resolved configuration of a command line, with the place that each value comes from."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

import yaml
from hydra.core.override_parser.types import Override

from .cell_options import CELL_GROUPS, changed_defaults
from .compose import algorithm_node, load_config, preset_arguments
from .earlier_options import flatten
from .overrides import parse_overrides
from .schema import Config
from .validation import ALL_GROUPS, CONF, NAMED_GROUPS, config_options

WIDTH = 44  # of a line of YAML before its comment
COMMAND_LINE = "command line"


def describe_config(arguments: Sequence[str]) -> str:
    """Return the configuration of a command line as YAML, each value with its place as a comment.

    The places are the default, the files of the network, the environment, the algorithm and the
    preset, and the command line. A value that refers to another option names it.

    Raises:
      ConfigError: the command line is invalid.
    """
    config = load_config(list(arguments))
    overrides = parse_overrides(list(arguments))
    stored = "repeat" if config.repeat else "resume" if config.resume else None
    places = dict.fromkeys(overrides, COMMAND_LINE) if stored else value_places(config, overrides)
    return "\n".join(yaml_lines(asdict(config), places, stored or "default"))


def yaml_lines(
    tree: dict[str, Any], places: dict[str, str], otherwise: str, prefix: str = ""
) -> Iterator[str]:
    """Yield the lines of a nested mapping as YAML, each value with a comment.

    Args:
      tree: the mapping.
      places: the comment of each value, by dotted name.
      otherwise: the comment of all others.
      prefix: of the names in this mapping, with its dot.
    """
    indent = "  " * prefix.count(".")
    for name, value in tree.items():
        key = f"{prefix}{name}"
        if isinstance(value, dict) and value and key not in ("env.options", "env.eta"):
            yield f"{indent}{name}:"
            yield from yaml_lines(value, places, otherwise, f"{key}.")
            continue
        text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=1000)
        line = f"{indent}{name}: {text.removesuffix('...' + chr(10)).strip()}"
        yield f"{line:<{WIDTH}} # {places.get(key, otherwise)}"


def value_places(config: Config, overrides: dict[str, Override]) -> dict[str, str]:
    """Return the place of every value that is not a default, by dotted name.

    Args:
      config: the resolved configuration.
      overrides: the options of the command line, by key.
    """
    found: dict[str, str] = {}
    for name, entry in config_options():
        if isinstance(entry.default, str) and entry.default.startswith("${"):
            found[name] = f"default{reference(entry.default)}"
    changed = changed_defaults(config.algo) if config.algo.module is None else {}
    for group in CELL_GROUPS:
        for name in changed.get(group, {}):
            found[f"{group}.{name}"] = f"algo={config.algo.name}"
    for layer, settings in layers(config, overrides):
        for name, value in settings.items():
            found[name] = f"{layer}{reference(value)}"
    for key in overrides:
        found[f"{key}.name" if key in NAMED_GROUPS else key] = COMMAND_LINE
        if key.startswith("env.options."):
            found["env.options"] = f"{found.get('env.options', 'default')}, {COMMAND_LINE}"
    return found


def reference(value: Any) -> str:
    """Return the option that a value refers to, as ", from NAME"; "" if it refers to none.

    >>> reference("${oc.select:env.eta.rnd,0.5}"), reference(3)
    (', from env.eta', '')
    """
    named = re.search(r"\b(env\.\w+)", value) if isinstance(value, str) else None
    return f", from {named[1]}" if named and value.startswith("${") else ""


def layers(config: Config, overrides: dict[str, Override]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the files that a configuration is made of, in order, each with its settings.

    Args:
      config: the resolved configuration.
      overrides: the options of the command line, by key.
    """
    chosen = {key: str(overrides[key].value()) for key in ALL_GROUPS if key in overrides}
    chosen.setdefault("network", config.network.name)
    if "algo.module" in overrides:
        chosen.setdefault("algo", "module")
    named: dict[str, Any] = {}  # by the preset
    if "preset" in chosen and "algo" not in chosen:
        named = dict(word.partition("=")[::2] for word in preset_arguments(chosen["preset"]))
        chosen["algo"] = named.pop("algo")
        named["algo.name"] = chosen["algo"]
    for group in ALL_GROUPS:
        if group in chosen:
            for settings in file_settings(group, chosen[group]):
                yield f"{group}={chosen[group]}", settings
    if named:
        yield f"preset={chosen['preset']}", named


def file_settings(group: str, name: str) -> Iterator[dict[str, Any]]:
    """Yield the settings that a file sets, by dotted name: those of the files it names come first.

    Args:
      group: of the file.
      name: of the file, or of a row in the table of algorithms.
    """
    path = CONF / group / f"{name}.yaml"
    if not path.is_file():
        yield flatten({group: algorithm_node(name)})
        return
    text = path.read_text()
    body = yaml.safe_load(text) or {}
    for entry in (one for one in body.pop("defaults", ()) if isinstance(one, dict)):
        ((key, value),) = entry.items()
        if key.startswith("override /"):
            yield {f"{key.removeprefix('override /')}.name": value}
        else:  # /family@env
            folder, _, package = key.strip("/").partition("@")
            package = group if package == "_here_" else package
            inner = yaml.safe_load((CONF / folder / f"{value}.yaml").read_text())
            yield kept_mappings({package: inner})
    yield kept_mappings(body if "@package _global_" in text else {group: body})


def kept_mappings(tree: dict[str, Any]) -> dict[str, Any]:
    """Return a nested mapping by dotted names; the mappings that are options stay whole."""
    return flatten(tree, keep=("env.options", "env.eta"))
