"""How a run learns from a rollout: in one program, or in pieces between which policies act."""

from collections.abc import Callable
from typing import Any, Protocol

import jax
import numpy as np

import sndjax
from sndjax.passes import count_steps
from sndjax.sliced_step import SlicedLearning, SlicedStep, make_sliced_step

from ..system.jax_settings import at_precision
from .experiment import Experiment
from .policy_lag import actor_of
from .seeds import map_over_seeds

SPREAD = 7 / 8  # of a rollout, over which the pieces of learning are spread

# (train, metrics, intrinsic rewards), leaves [S, ...]
Learned = tuple[sndjax.TrainState, dict[str, Any], Any]
# (name for the user, function, arguments) -> the compiled function, the seconds it may take
Compile = Callable[..., tuple[Callable[..., Any], float]]


class Learner(Protocol):
    """How a run learns. Everything is started and nothing waited for."""

    def compile(self, compiler: Compile, train: sndjax.TrainState, batch: Any) -> float:
        """Compile the programs, and return the seconds that an update may take.

        Args:
          compiler: compiles a function.
          train: the states of all seeds.
          batch: a rollout.
        """

    def begin(self, train: sndjax.TrainState, batch: Any) -> None:
        """Start to learn from a rollout; the states are donated.

        Args:
          train: the states of all seeds.
          batch: the rollout.
        """

    def learn_policy(self) -> sndjax.Actor:
        """Start the rest of what changes the policy, and return the policy after it."""

    def advance(self, share: float) -> None:
        """Start as much as belongs to this share of the next rollout."""

    def finish(self) -> Learned:
        """Start the rest, and return the result."""


class WholeLearner:
    """Learning as one program, which starts at once and runs beside whatever other devices do."""

    def __init__(self, experiment: Experiment):
        """Take the program of a run; nothing is compiled yet."""
        placement = experiment.placement
        self.program = placement.compile_train_step(experiment.make_train_step())

    def compile(self, compiler: Compile, train: sndjax.TrainState, batch: Any) -> float:
        self.update, seconds = compiler("update", self.program, train, batch)
        return seconds

    def begin(self, train: sndjax.TrainState, batch: Any) -> None:
        self.learned: Learned = self.update(train, batch)

    def learn_policy(self) -> sndjax.Actor:
        return actor_of(self.learned[0])

    def advance(self, share: float) -> None:
        """Do nothing: all of it was started."""

    def finish(self) -> Learned:
        return self.learned


class SlicedLearner:
    """Learning in pieces, for a device that runs one program after another and acts in between.

    The results do not depend on where the pieces end.
    """

    def __init__(self, experiment: Experiment):
        """Take the programs of a run; nothing is compiled yet."""
        config = experiment.config
        pieces = make_sliced_step(experiment.agent)
        own = lambda piece, shared=0: map_over_seeds(
            at_precision(config.precision, piece), config.num_seeds, shared
        )
        finish = with_finite_state(pieces) if config.on_nan == "stop" else pieces.finish
        self.programs = SlicedStep(
            begin=jax.jit(own(pieces.begin), donate_argnums=0),
            policy=jax.jit(own(pieces.policy, 2), donate_argnums=1),
            module=jax.jit(own(pieces.module, 2), donate_argnums=1),
            finish=jax.jit(own(finish)),
        )

    def compile(self, compiler: Compile, train: sndjax.TrainState, batch: Any) -> float:
        programs, none = self.programs, np.int32(0)
        learning, policy, module = jax.eval_shape(programs.begin, train, batch)
        begin, seconds = compiler("rewards", programs.begin, train, batch)
        taken, each = compiler("policy's pass", programs.policy, learning, policy, none, none)
        self.policy_steps = count_steps(learning.policy_inputs, axis=1)
        seconds += self.policy_steps * each
        self.module_steps, trained = 0, programs.module
        if learning.module_inputs is not None:
            trained, each = compiler("module's pass", trained, learning, module, none, none)
            self.module_steps = count_steps(learning.module_inputs, axis=1)
            seconds += self.module_steps * each
        finish, _ = compiler("end of an update", programs.finish, learning, policy, module)
        self.compiled = SlicedStep(begin, taken, trained, finish)
        return seconds

    def begin(self, train: sndjax.TrainState, batch: Any) -> None:
        self.learning: SlicedLearning
        self.learning, self.policy, self.module = self.compiled.begin(train, batch)
        self.taken = self.ahead = 0  # optimizer steps; those before the rollout began

    def learn_policy(self) -> sndjax.Actor:
        self.take(self.policy_steps)
        self.ahead = self.taken
        (policy, _), _ = self.policy.carry
        start = self.learning.start
        return sndjax.Actor(policy, start.observations, start.key)

    def advance(self, share: float) -> None:
        left = self.policy_steps + self.module_steps - self.ahead
        self.take(self.ahead + round(left * min(1.0, share / SPREAD)))

    def take(self, end: int) -> None:
        """Start the optimizer steps up to `end`, those of the policy first."""
        first, of_policy = self.taken, self.policy_steps
        if first < min(end, of_policy):
            bounds: Any = np.int32(first), np.int32(min(end, of_policy))
            self.policy = self.compiled.policy(self.learning, self.policy, *bounds)
        if end > max(first, of_policy):
            bounds = np.int32(max(first, of_policy) - of_policy), np.int32(end - of_policy)
            self.module = self.compiled.module(self.learning, self.module, *bounds)
        self.taken = max(first, end)

    def finish(self) -> Learned:
        self.take(self.policy_steps + self.module_steps)
        learned = self.compiled.finish(self.learning, self.policy, self.module)
        del self.learning, self.policy, self.module  # the rollout's memory
        return learned


def with_finite_state(pieces: SlicedStep) -> Callable[..., Any]:
    """Return the last piece with the metric `state_finite`, see `make_seed_train_step`."""

    def finish(learning: SlicedLearning, policy: Any, module: Any) -> Any:
        state, metrics, reward = pieces.finish(learning, policy, module)
        fine = sndjax.all_finite(state._replace(key=()))  # type: ignore[arg-type]
        return state, metrics | {"state_finite": fine}, reward

    return finish


def make_learner(experiment: Experiment) -> WholeLearner | SlicedLearner:
    """Return how a run learns.

    In pieces where acting and learning share an accelerator. With on_nan=skip, which keeps the
    state before an iteration until its end, and on a mesh of devices it is one program.

    Args:
      experiment: of the run.
    """
    placement, config = experiment.placement, experiment.config
    shared = placement.acting is placement and placement.axis is None
    if jax.default_backend() == "cpu" or not shared or config.on_nan == "skip":
        return WholeLearner(experiment)
    return SlicedLearner(experiment)
