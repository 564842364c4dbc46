"""Stored configurations of earlier versions: their options under the names of today."""

from typing import Any

from .library import algorithm_table


def rename_earlier(found: dict[str, Any]) -> dict[str, Any]:
    """Return a stored configuration, nested as in its file, with the options of today.

    - `network: small` was a word; it is `network.name`.
    - `algo.activation` is `network.module.activation`.
    - `algo.gradient` is `signal.gradient`, of the signal that has it.
    - the weights of ICM's two losses were no options; they are those of its table.

    Args:
      found: what the file holds; it is not changed.

    >>> rename_earlier({"network": "small", "algo": {"name": "rnd", "activation": "relu"}})
    {'network': {'name': 'small', 'module': {'activation': 'relu'}}, 'algo': {'name': 'rnd'}}
    """
    made = dict(found)
    if isinstance(made.get("network"), str):
        made["network"] = {"name": made["network"]}
    algo = made.get("algo")
    if not isinstance(algo, dict):
        return made
    made["algo"] = algo = dict(algo)
    activation, gradient = algo.pop("activation", None), algo.pop("gradient", None)
    if activation not in (None, "elu") and isinstance(made.get("network", {}), dict):
        made["network"] = {**made.get("network", {}), "module": {"activation": activation}}
    if gradient is not None and algo.get("signal") == "prediction":
        made["signal"] = {"gradient": gradient}
    row = algorithm_table().get(str(algo.get("name")))
    if row is not None and "objective_weight" not in algo:
        algo.update(loss_weights(row))
    return made


def rename_argument(argument: str) -> str:
    """Return an argument of an earlier version's command line with the name of today.

    >>> rename_argument("algo.activation=relu"), rename_argument("seed=1")
    ('network.module.activation=relu', 'seed=1')
    """
    key, equals, value = argument.partition("=")
    names = {"algo.activation": "network.module.activation", "algo.gradient": "signal.gradient"}
    return f"{names.get(key, key)}{equals}{value}"


def loss_weights(row: Any) -> dict[str, float]:
    """Return the options that weigh the losses of a named algorithm; {} where both weigh 1."""
    if "weights" not in row.options:
        return {}
    return dict(zip(("objective_weight", "signal_weight"), row.options["weights"], strict=True))


def rename_settings(stored: dict[str, Any]) -> dict[str, Any]:
    """Return stored settings by dotted names, as in a checkpoint, with the names of today.

    >>> rename_settings({"network": "thesis", "seed": 1})
    {'network.name': 'thesis', 'seed': 1}
    """
    nested: dict[str, Any] = {}
    for name, value in stored.items():
        place = nested
        *outer, last = name.split(".")
        for part in outer:
            place = place.setdefault(part, {})
        place[last] = value
    return flatten(rename_earlier(nested), keep=("env.options", "env.eta"))


def flatten(tree: dict[str, Any], prefix: str = "", keep: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return a nested mapping by dotted names.

    Args:
      tree: the mapping.
      prefix: of all names, with its dot.
      keep: names of mappings that stay mappings.

    >>> flatten({"a": {"b": 1, "c": {}}})
    {'a.b': 1}
    """
    found: dict[str, Any] = {}
    for name, value in tree.items():
        if isinstance(value, dict) and f"{prefix}{name}" not in keep:
            found |= flatten(value, f"{prefix}{name}.", keep)
        else:
            found[f"{prefix}{name}"] = value
    return found
