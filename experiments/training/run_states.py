"""What a checkpoint holds beside the states of learning, so that a run continues exactly."""

from typing import Any

from ..storage.array_trees import CheckpointError
from ..storage.checkpoints import Checkpoints
from ..storage.episodes import EpisodeTracker
from ..system.errors import ConfigError
from .experiment import Experiment, RunState
from .run_logger import RunLogger


def trees_beside(
    state: RunState, experiment: Experiment, episodes: EpisodeTracker
) -> dict[str, Any]:
    """Return the trees that a checkpoint holds beside the states of learning, by name.

    Environments that step outside jax cannot be stored: their episodes begin again.

    Args:
      state: of the run.
      experiment: of the run.
      episodes: the running sums of the current episodes.
    """
    found: dict[str, Any] = {}
    if experiment.pool.environment is not None:
        environments = experiment.placement.to_host(state.environments)
        found = {"environments": environments, "episodes": episodes.arrays()}
    if experiment.config.overlap:
        found["next_actor"] = experiment.placement.to_host(state.next_actor)
    return found


def resume_run_state(
    logger: RunLogger, experiment: Experiment, episodes: EpisodeTracker
) -> RunState | None:
    """Return the state of the checkpoint that a run resumes from; None for a new run.

    Args:
      logger: of the run.
      experiment: of the run.
      episodes: the running sums, which are set to those of the checkpoint.

    Raises:
      ConfigError: the checkpoint cannot be used.
    """
    if logger.found is None:
        return None
    try:
        return load_run_state(logger.checkpoints, experiment, episodes)
    except CheckpointError as error:
        raise ConfigError(f"resume={logger.shared}: cannot be resumed: {error}") from None


def load_run_state(
    checkpoints: Checkpoints, experiment: Experiment, episodes: EpisodeTracker
) -> RunState:
    """Return the state of the newest checkpoint.

    Args:
      checkpoints: of the run.
      experiment: of the run.
      episodes: the running sums, which are set to those of the checkpoint.

    Raises:
      CheckpointError: the checkpoint cannot be used.
    """
    assert checkpoints.newest is not None
    like = experiment.run_shapes()
    train = checkpoints.load(checkpoints.newest, like.train)
    wanted: dict[str, Any] = {}
    if experiment.pool.environment is not None:
        wanted = {"environments": like.environments, "episodes": episodes.arrays()}
    if experiment.config.overlap:
        wanted["next_actor"] = like.next_actor
    beside = checkpoints.load_beside(checkpoints.newest, wanted) if wanted else {}
    if "episodes" in beside:
        episodes.restore(beside["episodes"])
    own = (train, beside.get("environments", ()), beside.get("next_actor", ()))
    return RunState(*map(experiment.placement.put_states, own))
