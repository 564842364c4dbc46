"""Trained agents that are loaded from a run and play episodes without training."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import sndjax
from sndjax import TrainState
from sndjax.acting import scale_observations

from ..config.config_checks import validate_config
from ..config.saved import CONFIG, check_code, read_saved
from ..config.schema import Config
from ..environments.pools import env_seeds, make_pool, make_pool_of, whole_games
from ..storage.array_trees import CheckpointError
from ..storage.checkpoints import Checkpoints
from ..system.errors import ConfigError
from ..system.jax_settings import at_precision
from ..training.experiment import build_experiment
from ..training.snapshots import to_rgb

CHUNK = 256
MAX_STEPS = 27_000  # the longest episode: as many steps as ALE gives a game, of four frames each
KEPT_BYTES = 2 << 30  # the memory for what is played; longer episodes are cut
ROW_BYTES = 64  # of one step without its frame


class Player(NamedTuple):
    """An agent with the state of one seed."""

    config: Config
    agent: sndjax.AgentSpec
    state: TrainState
    seed: int
    iteration: int  # of the checkpoint


class PlayedEpisode(NamedTuple):
    """One played episode, L transitions."""

    frames: np.ndarray  # [L + 1, *frame], as the module sees them
    action: np.ndarray  # int32[L], the policy's choice
    executed: np.ndarray  # int32[L], the action that the environment received
    value: np.ndarray  # float32[L, K]
    reward: np.ndarray  # float32[L], the training reward
    score: np.ndarray  # float32[L]
    room: np.ndarray  # uint8[L], in Montezuma's Revenge; zeros in other games
    stream: int  # the seed of its environment
    complete: bool  # False: it was cut before its end


def find_state(run: Path, like: Any) -> tuple[int, TrainState]:
    """Load the newest complete checkpoint of a run.

    Args:
      run: the run directory.
      like: the shapes and dtypes of the states.

    Returns:
      The iteration of the checkpoint, and the states of all seeds.

    Raises:
      ConfigError: there is no checkpoint, or none can be used.
    """
    checkpoints = Checkpoints(run)
    try:
        step, _, said = checkpoints.find(lambda manifest: None)
        if step is None:
            raise ConfigError(f"{run}: there is no checkpoint")
        for line in said:
            print(f"{run}: {line}")
        return step, checkpoints.load(step, like)
    except CheckpointError as error:
        raise ConfigError(f"{run}: no checkpoint can be used: {error}") from None


def load_players(run: Path, trust: tuple[str, ...] = ()) -> list[Player]:
    """Load the agents of a run, one for each seed.

    Args:
      run: the run directory.
      trust: the code that the run's stored configuration may name, if it names any: the values of
        its `algo.module` and `env.id`.

    Raises:
      ConfigError: there is no run, its configuration names code that is not in `trust`, or none of
        its checkpoints can be used.
    """
    if not (run / CONFIG).is_file():
        raise ConfigError(f"{run}: there is no run (no {CONFIG})")
    config = read_saved(run / CONFIG).config
    named: dict[str, Any] = {"algo.module": config.algo.module, "env.id": config.env.id}
    check_code(config, {k: v for k, v in named.items() if v in trust}, str(run))
    config = validate_config(config)
    config = replace(config, env=whole_games(config.env))
    experiment = build_experiment(config, probe=True)
    iteration, states = find_state(run, experiment.run_shapes().train)
    own = lambda i: jax.tree.map(lambda x: jnp.asarray(x[i]), states)
    return [
        Player(config, experiment.agent, own(i), seed, iteration)
        for i, seed in enumerate(config.seeds)
    ]


def make_choose(player: Player, greedy: bool, seed: int) -> Callable[..., Any]:
    """Return a jitted function that chooses the actions of one step.

    Args:
      player: the agent that plays.
      greedy: take the most probable action instead of sampling one.
      seed: the seed of the sampled actions.

    Returns:
      (memory, frame, first, step) -> (action, executed, value, memory).
    """
    agent, state = player.agent, player.state
    key = jax.random.fold_in(state.key, seed)
    actor = sndjax.Actor(state.policy, state.observations, key)

    def choose(
        memory: sndjax.ActorMemory, frame: jax.Array, first: jax.Array, step: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array, sndjax.ActorMemory]:
        output, memory = sndjax.act(agent, actor, memory, frame, first, step, greedy)
        return output.action, output.executed, output.value, memory

    return jax.jit(at_precision(player.config.precision, choose))


def step_limit(max_steps: int, episodes: int, frame_bytes: int) -> int:
    """Return the number of steps after which an episode is cut.

    Args:
      max_steps: the limit that was asked for.
      episodes: the number of episodes that are played in parallel.
      frame_bytes: the size of a frame; 0 if frames are not kept.

    >>> step_limit(27_000, 16, 0), step_limit(27_000, 1024, 96 * 96)
    (27000, 225)
    """
    return max(1, min(max_steps, KEPT_BYTES // (episodes * (frame_bytes + ROW_BYTES))))


def cut_message(played: list[PlayedEpisode], max_steps: int) -> str:
    """Return the line that says how many episodes were cut and why, or "" if all are complete."""
    cut = [len(episode.action) for episode in played if not episode.complete]
    if not cut:
        return ""
    full = "they fill the memory: play fewer episodes"
    why = f"max_steps={max_steps}" if cut[0] >= max_steps else full
    steps = f"{cut[0]:,} steps"
    return f"{len(cut)} of {len(played)} episodes had no end after {steps} and were cut ({why})"


def play_episodes(
    player: Player,
    episodes: int,
    greedy: bool = False,
    seed: int = 0,
    keep: bool = True,
    report: Callable[[int, int], None] = lambda steps, ended: None,
    max_steps: int = MAX_STEPS,
) -> list[PlayedEpisode]:
    """Play whole episodes, one in each environment, so that short ones are not counted more often.

    An episode that has not ended after `max_steps` steps, or where the memory is full, is cut.

    Args:
      player: the agent that plays.
      episodes: the number of episodes, played in parallel.
      greedy: take the most probable action instead of sampling one.
      seed: the seed of the environments and of the sampled actions.
      keep: whether to keep all frames; if False, only the first is kept.
      report: called with the number of steps taken and the number of episodes that have ended.
      max_steps: the longest episode.

    Raises:
      ConfigError: the environment cannot be made.
    """
    env, stack = player.config.env, player.config.env.stack
    pool = make_pool(env, [seed], episodes)
    choose = make_choose(player, greedy, seed)
    frame, first = pool.reset()[0], np.ones(episodes, bool)
    memory = sndjax.ActorMemory(
        jnp.zeros((stack, episodes, *pool.shape), pool.dtype),
        player.agent.network.initial_memory(episodes),
    )
    limit = step_limit(max_steps, episodes, frame[0].nbytes if keep else 0)
    alive, length = np.ones(episodes, bool), np.zeros(episodes, int)
    frames: list[list[np.ndarray]] = [[one] for one in frame.copy()]
    rows: list[tuple[np.ndarray, ...]] = []
    while alive.any() and len(rows) < limit:
        *decided, memory = choose(memory, frame, first, np.int32(len(rows)))
        action, executed, value = map(np.asarray, decided)
        step = pool.step(executed[None])
        room = np.zeros(alive.shape, np.uint8) if step.room is None else step.room[0]
        columns = (action, executed, value, step.reward[0], step.score[0], room)
        rows.append(tuple(np.array(column) for column in columns))
        length += alive
        for n in np.nonzero(alive)[0].tolist() if keep else ():
            frames[n].append(step.frame[0, n].copy())
        alive &= ~step.done[0]
        frame, first = step.frame[0], ~step.valid[0]
        report(len(rows), episodes - int(alive.sum()))
    pool.close()
    table = [np.stack(column) for column in zip(*rows, strict=True)]
    found = []
    for n, stream in enumerate(env_seeds(seed, episodes, 0)):
        taken: Any = [column[: length[n], n] for column in table]
        own = np.stack(frames[n])
        frames[n] = []  # the memory is needed for the others
        found.append(PlayedEpisode._make([own, *taken, stream, not alive[n]]))
    return found


def render_episode(player: Player, episode: PlayedEpisode) -> Iterator[np.ndarray]:
    """Yield an image of every state of an episode, uint8[H, W, 3].

    A task of envpool or in JAX is played a second time, and its states are drawn. For other tasks
    the images are the frames.

    Args:
      player: the agent that played.
      episode: the episode, with all its frames.

    Raises:
      ConfigError: the task has no images, or the second time the frames are different.
    """
    env = player.config.env
    if env.suite == "gymnasium":
        if episode.frames.dtype != np.uint8:
            raise ConfigError(f"{env.id}: of gymnasium's tasks only those with images can be drawn")
        yield from map(to_rgb, episode.frames)
        return
    options = {"render_mode": "rgb_array"} if env.suite == "envpool" else {}
    pool = make_pool_of(replace(env, options=env.options | options), [[episode.stream]])
    frame = pool.reset()[0, 0]
    for t in range(len(episode.frames)):
        if not np.array_equal(frame, episode.frames[t]):
            raise ConfigError(f"{env.id}: the replay differs from the recorded episode at step {t}")
        yield pool.draw()
        if t < len(episode.executed):
            frame = pool.step(episode.executed[None, t : t + 1]).frame[0, 0]
    pool.close()


def episode_novelty(player: Player, episode: PlayedEpisode) -> np.ndarray:
    """Return the unscaled signal of every transition, float32[L], with the checkpoint's weights.

    The baseline has zeros. The memory of an episodic signal is empty at the start.
    """
    intrinsic, length = player.agent.intrinsic, len(episode.action)
    if intrinsic is None:
        return np.zeros(length, np.float32)
    module = intrinsic.module
    short = -length % CHUNK  # so that `map_over_time` can take CHUNK frames at once
    column = lambda x, fill: jnp.pad(jnp.asarray(x), (0, short), constant_values=fill)[:, None]
    frames = np.concatenate([episode.frames, episode.frames[-1:].repeat(short, 0)])[:, None]
    seen = scale_observations(player.agent, jnp.asarray(frames), player.state.observations)
    steps = np.arange(length)
    rollout = sndjax.Rollout(
        seen,
        column(episode.action, 0),
        column(steps == 0, False),
        column(steps == length - 1, False),
        column(np.ones(length, bool), False),
    )
    _, fresh = jax.eval_shape(module.init, jax.random.key(0), seen[0])
    blank = lambda kept, new: kept if kept.shape == new.shape else jnp.zeros(new.shape, new.dtype)
    state = jax.tree.map(blank, player.state.intrinsic_state, fresh)
    value, _ = jax.jit(module.reward)(player.state.intrinsic, state, rollout, jax.random.key(0))
    return np.asarray(value)[:length, 0]
