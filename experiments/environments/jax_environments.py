"""Environments that live in JAX, of other libraries or of the user, as `sndjax.JaxEnvironment`.

Each library's own step and reset are used without its automatic resets: some of these lose an
episode's last observation or go back to stored first states.
"""

import importlib
import warnings
from collections.abc import Callable, Iterable
from dataclasses import fields
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import sndjax
from sndjax.jax_environment import check_environment

from ..config.envpool_tasks import gym
from ..config.jax_suites import check_installed
from ..config.schema import EnvConfig
from ..config.user_function import call_user_function
from ..config.validation import unknown_name_error
from ..system.errors import ConfigError
from .observations import Reader

Options = dict[str, Any]
MINIGRID_KINDS = (11, 6, 4)  # navix' objects, colours and states
XMINIGRID_KINDS = (13, 12)  # its tiles and colours
CRAFTAX_PIXELS = 16  # the side of a drawn block, for which Craftax has pictures
GRID_PIXELS = 320  # the larger side of a drawn grid
SMALL = 32  # an observation of navix with a smaller side is of categories


def check_known(what: str, name: str, known: Iterable[str]) -> None:
    """Raise ConfigError unless a name is known.

    Args:
      what: the kind of thing that is named.
      name: the name.
      known: all known names.

    Raises:
      ConfigError: it is not.
    """
    known = list(known)
    if name not in known:
        raise unknown_name_error(what, name, known)


def make_gymnax(name: str, options: Options) -> sndjax.JaxEnvironment:
    """Make a task of gymnax; options are its constructor's, or fields of its parameters."""
    import gymnax

    check_known("gymnax task", name, gymnax.registered_envs)
    of_params = {field.name for field in fields(gymnax.make(name)[1])}
    own = {key: value for key, value in options.items() if key not in of_params}
    env, params = gymnax.make(name, **own)
    params = params.replace(**{key: options[key] for key in options if key not in own})

    def reset(key: Any) -> Any:
        observation, state = env.reset_env(key, params)
        return state, observation

    def step(key: Any, state: Any, action: Any) -> Any:
        observation, state, reward, terminated, _ = env.step_env(key, state, action, params)
        return state, observation, reward, terminated, env.is_truncated(state, params)

    grid = len(env.observation_space(params).shape) in (2, 3)
    made = spaces_of(env, params, reset, step)
    if name == "DeepSea-bsuite":  # an episode ends below the last row
        cell: Callable[[Any], Any] = lambda state: state.row * env.size + state.column
        made = made._replace(place=cell, num_places=(env.size + 1) * env.size)
    return made._replace(draw=lambda state: draw_grid(env.get_obs(state))) if grid else made


def make_craftax(name: str, options: Options) -> sndjax.JaxEnvironment:
    """Make Craftax, symbolic or in pixels; options are fields of its parameters."""
    from craftax.craftax_env import make_craftax_env_from_name

    kinds = ("Craftax", "Craftax-Classic")
    known = [f"{kind}-{look}-v1" for kind in kinds for look in ("Symbolic", "Pixels")]
    check_known("craftax task", name, known)
    env: Any = make_craftax_env_from_name(name, auto_reset=False)
    params = env.default_params.replace(**options)

    def reset(key: Any) -> Any:
        observation, state = env.reset_env(key, params)
        return state, observation

    def step(key: Any, state: Any, action: Any) -> Any:
        observation, state, reward, _, _ = env.step_env(key, state, action, params)
        terminated = env.is_terminal(state.replace(timestep=0), params)
        return state, observation, reward, terminated, state.timestep >= params.max_timesteps

    place = "craftax.craftax_classic" if "Classic" in name else "craftax.craftax"

    @cache
    def renderer() -> Any:
        module = importlib.import_module(f"{place}.renderer")
        return jax.jit(module.make_craftax_pixel_renderer(CRAFTAX_PIXELS))

    def draw(state: Any) -> np.ndarray:
        return np.clip(renderer()(state), 0, 255).astype(np.uint8)

    return spaces_of(env, params, reset, step)._replace(draw=draw)


def spaces_of(env: Any, params: Any, reset: Any, step: Any) -> sndjax.JaxEnvironment:
    """Return the environment of functions, with the spaces as gymnax has them.

    Args:
      env: with `action_space` and `observation_space`.
      params: its parameters.
      reset: see `sndjax.JaxEnvironment`.
      step: see there.

    Raises:
      ConfigError: the actions are not discrete, or the observations are not one array.
    """
    actions, space = env.action_space(params), env.observation_space(params)
    if not hasattr(actions, "n"):
        raise ConfigError(
            f"its actions are {type(actions).__name__} of shape {actions.shape}; only tasks with "
            "discrete actions can be trained on"
        )
    if hasattr(space, "n"):
        return sndjax.JaxEnvironment(reset, step, int(actions.n), categories=int(space.n))
    return sndjax.JaxEnvironment(reset, step, int(actions.n), low=space.low, high=space.high)


def draw_grid(grid: Any) -> np.ndarray:
    """Return an image of a grid of numbers or of channels, with a colour for each channel.

    Args:
      grid: [H, W] or [H, W, C], of 0 to 1.
    """
    grid = np.asarray(grid, np.float32)
    channels = grid[..., None] if grid.ndim == 2 else grid
    hues = np.arange(channels.shape[-1]) / channels.shape[-1]
    colours = np.stack([(1 + np.cos(2 * np.pi * (hues + k / 3))) / 2 for k in range(3)], axis=-1)
    image = np.clip(channels @ colours, 0, 1) * 255
    side = max(1, GRID_PIXELS // max(grid.shape[:2]))
    return image.astype(np.uint8).repeat(side, 0).repeat(side, 1)


def make_xminigrid(name: str, options: Options) -> sndjax.JaxEnvironment:
    """Make a task of XLand-MiniGrid; options are fields of its parameters, such as `max_steps`."""
    import xminigrid

    check_known("xminigrid task", name, xminigrid.registered_environments())
    env, params = xminigrid.make(name, **options)

    def reset(key: Any) -> Any:
        timestep = env.reset(params, key)
        return timestep, timestep.observation

    def step(key: Any, timestep: Any, action: Any) -> Any:
        timestep = env.step(params, timestep, action)
        ended, terminated = timestep.last(), timestep.discount == 0
        observation, reward = timestep.observation, timestep.reward
        return timestep, observation, reward, ended & terminated, ended & ~terminated

    actions = env.num_actions(params)
    draw = lambda timestep: env.render(params, timestep)
    return sndjax.JaxEnvironment(reset, step, actions, categories=XMINIGRID_KINDS, draw=draw)


def make_navix(name: str, options: Options) -> sndjax.JaxEnvironment:
    """Make a task of navix; `observation_fn` is a name in `navix.observations`."""
    import navix

    check_known("navix task", name, navix.registry())
    view = options.get("observation_fn")
    if view is not None:
        check_known("value of env.options.observation_fn", view, vars(navix.observations))
        options = options | {"observation_fn": getattr(navix.observations, view)}
    env = navix.make(name, disable_autoreset=True, **options)

    def reset(key: Any) -> Any:
        timestep = env.reset(key)
        return timestep, timestep.observation

    def step(key: Any, timestep: Any, action: Any) -> Any:
        timestep = env.step(timestep, action)
        ends = timestep.is_termination(), timestep.is_truncation()
        return timestep, timestep.observation, timestep.reward, *ends

    actions, shape = len(env.action_set), env.observation_space.shape
    draw = lambda timestep: navix.observations.rgb(timestep.state)
    made = sndjax.JaxEnvironment(reset, step, actions, low=0, high=255, draw=draw)
    if len(shape) == 3 and shape[0] >= SMALL:
        return made
    return made._replace(categories=MINIGRID_KINDS if len(shape) == 3 else MINIGRID_KINDS[0])


def make_minigrid_level(name: str, options: Options) -> sndjax.JaxEnvironment:
    """Make a level of minigrid that is the same in every episode; see `make_level`."""
    with warnings.catch_warnings():  # of pygame, which draws
        warnings.simplefilter("ignore")
        from .levels.level_environment import make_level

    return make_level(name, **options)


def make_own(reference: str, options: Options) -> sndjax.JaxEnvironment:
    """Make the user's environment: FILE.py:FUNCTION, called with the options.

    Raises:
      ConfigError: the function raises an error or returns another type.
    """
    made = call_user_function("env.id", reference, **options)
    if not isinstance(made, sndjax.JaxEnvironment):
        raise ConfigError(
            f"env.id={reference}: {reference.rpartition(':')[2]}(...) must return an "
            f"sndjax.JaxEnvironment, not {type(made).__name__}"
        )
    return made


MAKERS: dict[str, Callable[[str, Options], sndjax.JaxEnvironment]] = {
    "gymnax": make_gymnax,
    "craftax": make_craftax,
    "xminigrid": make_xminigrid,
    "navix": make_navix,
    "levels": make_minigrid_level,
    "jax": make_own,
}


def make_environment(config: EnvConfig) -> sndjax.JaxEnvironment:
    """Return the environment of a configuration, with its observations as they are.

    Raises:
      ConfigError: its package is not installed, it cannot be made with these options, or its
        functions do not fit each other.
    """
    check_installed(config.suite)
    try:
        env = MAKERS[config.suite](config.id, config.options)
        check_environment(env)
    except ConfigError as error:
        text = str(error)
        named = config.id in text
        raise ConfigError(text if named else f"env.id={config.id}: {text}") from None
    except (Exception, SystemExit) as error:  # the library or the user may raise anything
        message = str(error).strip().splitlines() or [type(error).__name__]
        raise ConfigError(f"{config.suite} cannot make {config.id}: {message[0]}") from None
    return env


def observation_space(env: sndjax.JaxEnvironment) -> Any:
    """Return the gymnasium space of an environment's observations.

    Raises:
      ConfigError: the observations are not one array.
    """
    _, observation = jax.eval_shape(env.reset, jax.random.key(0))
    if not hasattr(observation, "shape"):
        raise ConfigError("its observations are not one array; only one array can be read")
    shape, dtype = observation.shape, observation.dtype
    if env.categories is not None:
        return gym.spaces.MultiDiscrete(np.broadcast_to(np.asarray(env.categories), shape))
    bounds = (np.broadcast_to(np.asarray(x, np.float64), shape) for x in (env.low, env.high))
    if np.issubdtype(dtype, np.integer):
        limits = np.iinfo(dtype)
        bounds = (np.clip(x, limits.min, limits.max) for x in bounds)
    low, high = (x.astype(np.float32 if np.dtype(dtype).kind == "b" else dtype) for x in bounds)
    return gym.spaces.Box(low, high, dtype=low.dtype.type)


def read_frames(env: sndjax.JaxEnvironment, reader: Reader) -> sndjax.JaxEnvironment:
    """Return the environment with its observations read as frames.

    Args:
      env: the environment.
      reader: of its observations.
    """
    read = lambda observation: reader.read(jnp.asarray(observation)[None])[0]

    def reset(key: Any) -> Any:
        state, observation = env.reset(key)
        return state, read(observation)

    def step(key: Any, state: Any, action: Any) -> Any:
        state, observation, *rest = env.step(key, state, action)
        return state, read(observation), *rest

    return env._replace(reset=reset, step=step)
