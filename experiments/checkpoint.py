"""Orbax checkpoints of the whole train state."""

from pathlib import Path

import jax
import orbax.checkpoint as ocp

from experiments.options import ConfigError
from sndjax import TrainState

KEEP = 2  # the newest checkpoints that stay


class Checkpoints:
    """The checkpoints of a run directory, numbered by iteration."""

    def __init__(self, path: Path):
        options = ocp.CheckpointManagerOptions(max_to_keep=KEEP, create=False)
        (path / "checkpoints").mkdir(exist_ok=True)
        self.manager = ocp.CheckpointManager((path / "checkpoints").resolve(), options=options)

    def save(self, iteration: int, state: TrainState) -> None:
        """Write the state, and return when it is whole on the disk."""
        self.manager.save(iteration, args=ocp.args.StandardSave(raw(state)))
        self.manager.wait_until_finished()

    def restore(self, like: TrainState) -> tuple[int, TrainState] | None:
        """The newest checkpoint with its iteration, or None where there is none.

        Raises:
          ConfigError: it does not fit this configuration.
        """
        iteration = self.manager.latest_step()
        if iteration is None:
            return None
        abstract = jax.eval_shape(raw, like)
        try:
            state = self.manager.restore(iteration, args=ocp.args.StandardRestore(abstract))
        except (ValueError, KeyError, TypeError, OSError) as error:
            cause = str(error).strip().splitlines()[0]
            raise ConfigError(f"checkpoint {iteration} cannot be restored: {cause}") from None
        return iteration, state._replace(key=jax.random.wrap_key_data(state.key))

    def close(self) -> None:
        """Stop orbax's threads."""
        self.manager.close()


def raw(state: TrainState) -> TrainState:
    """The state with its key as plain integers."""
    return state._replace(key=jax.random.key_data(state.key))
