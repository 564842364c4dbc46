"""The sizes of the networks of a configuration for the observations of its environment."""

from typing import Any, Literal

import numpy as np

import sndjax
from sndjax.architectures import NETWORKS

from ..config.schema import Config, NetworkSizes
from ..environments.pool import Pool
from ..system.errors import ConfigError


def module_activation(config: Config) -> str:
    """Return the activation of the intrinsic module's networks."""
    network = config.network
    return network.module.activation or network.activation or "elu"


def given_sizes(config: Config, part: Literal["policy", "module"]) -> dict[str, tuple[str, Any]]:
    """Return the sizes that are given for the policy or the module: the option and the value.

    Those of the part alone come before those of all networks.

    Args:
      config: the configuration.
      part: "policy" or "module".
    """
    found = {}
    for prefix, sizes in (
        ("network", config.network),
        (f"network.{part}", getattr(config.network, part)),
    ):
        for name in NetworkSizes.__dataclass_fields__:
            value = getattr(sizes, name)
            if value is not None:
                found[name] = (f"{prefix}.{name}", value)
    return found


def network_sizes(
    config: Config, pool: Pool, part: Literal["policy", "module"]
) -> sndjax.Architecture:
    """Return the sizes of the policy's or the module's networks for the frames of a pool.

    Args:
      config: the configuration.
      pool: the environments.
      part: "policy" or "module".

    Raises:
      ConfigError: the network is for pixels, and the environment has none; or a size is impossible
        for these frames.
    """
    pixels = pool.dtype == np.uint8
    if config.network.name == "small" and not pixels:
        raise ConfigError(
            f"network=small (also set by preset=laptop) is for pixels; {config.env.id} has none"
        )
    shape = tuple(pool.shape)
    size = named_size(config.network.name, shape, pixels)
    changed: dict[str, Any] = {}
    given = given_sizes(config, part)
    if "channels" in given and pixels:  # they decide whether the others have a meaning
        size = size._replace(**changed_fields("channels", given["channels"][1]))
    for name, (option, value) in given.items():
        problem = misfit(name, size, pixels)
        if problem:
            raise ConfigError(f"{option}={value}: {problem} (observations of shape {shape})")
        changed |= changed_fields(name, value)
    if part == "policy":
        changed["memory"] = config.network.memory
    size = size._replace(**changed)
    check_patches(size, given, shape)
    return size


def named_size(name: str, shape: tuple[int, ...], pixels: bool) -> sndjax.Architecture:
    """Return the sizes of a named network: for vectors, for gray pixels, for all other pixels.

    Args:
      name: of the network.
      shape: of a frame.
      pixels: whether frames are pixels.
    """
    named = NETWORKS[name]
    if not pixels:
        return named.vector
    return named.gray if shape[-1] == 1 else named.colour


def misfit(name: str, size: sndjax.Architecture, pixels: bool) -> str:
    """Return why a size has no meaning for these networks, or "".

    Args:
      name: of the size.
      size: the networks.
      pixels: whether observations are pixels.
    """
    if name == "channels" and not pixels:
        return "the observations are vectors, which no convolution reads"
    if name in ("last", "patch") and not size.channels:
        return "these networks have no convolutions"
    if name == "hidden" and size.channels:
        return "convolutions read these observations; hidden layers are those of network=mlp"
    return ""


def changed_fields(name: str, value: Any) -> dict[str, Any]:
    """Return the fields of an `Architecture` that a size sets; `channels` sets those of all.

    Args:
      name: of the size.
      value: the size.
    """
    if name == "channels":
        every = ("channels", "rnd_channels", "snd_v_channels") if value else ("channels",)
        return dict.fromkeys(every, tuple(value))
    if name == "last":
        return {"last": value, "last_predictor": value}
    if name == "activation":  # of modules it is an argument of `make_module`
        return {} if value == "published" else {"activation": value}
    return {name: tuple(value) if isinstance(value, list) else value}


def check_patches(
    size: sndjax.Architecture, given: dict[str, tuple[str, Any]], shape: tuple[int, ...]
) -> None:
    """Check that the convolutions leave something of the frames.

    Args:
      size: the networks.
      given: the sizes that the configuration gives.
      shape: of a frame.

    Raises:
      ConfigError: a map would be empty; the message names its shape.
    """
    sides = shape[:2]
    for i, layer in enumerate(size.convolutions(size.last)):
        sides = tuple((s + 2 * layer.padding - layer.size) // layer.stride + 1 for s in sides)
        if min(sides) < 1:
            option, value = given.get("patch", ("network", size.patch))
            raise ConfigError(
                f"{option}={value}: layer {i + 1} would make a map of "
                f"{' x '.join(map(str, (*sides, layer.channels)))} of frames of shape {shape}"
            )
