"""`train_step` in pieces: four programs, of which two take any number of optimizer steps.

Between two pieces a device can do something else: act, while environments step. An accelerator runs
its programs one after another, so the only way to act while it learns is between two pieces.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from jaxtyping import Array, Float, Int

from sndjax.acting import AgentSpec
from sndjax.intrinsic_training import IntrinsicTrainState, module_part
from sndjax.optimizer_steps import mean_metrics
from sndjax.passes import Pass, PassState, run_slice, start_pass
from sndjax.train import LearningStart, begin_learning, finish_learning
from sndjax.types import Experience, Metrics, TrainState
from sndjax.updates import PolicyState, finish_policy_pass, intrinsic_pass, policy_pass


class SlicedLearning(NamedTuple):
    """What stays the same while an iteration learns.

    Attributes:
      start: the rewards and advantages; its state is without weights, which the passes hold.
      policy_inputs: of each optimizer step of the policy, leaves [M, ...].
      module_inputs: of the module; None if nothing of it is trained.
    """

    start: LearningStart
    policy_inputs: Any
    module_inputs: Any


RunSlice = Callable[[SlicedLearning, PassState, Int[Array, ""], Int[Array, ""]], PassState]
TrainResult = tuple[TrainState, Metrics, Float[Array, "T N"]]


class SlicedStep(NamedTuple):
    """The pieces of `train_step`; each is pure, to be jitted.

    Attributes:
      begin: (state, batch) -> (learning, the policy's pass, the module's pass).
      policy: (learning, pass, first, end) -> pass, after these of its optimizer steps.
      module: the same for the module; not to be called where `module_inputs` is None.
      finish: (learning, policy's pass, module's pass) -> (state, metrics, intrinsic rewards).
    """

    begin: Callable[[TrainState, Experience], tuple[SlicedLearning, PassState, PassState]]
    policy: RunSlice
    module: RunSlice
    finish: Callable[[SlicedLearning, PassState, PassState], TrainResult]


def make_sliced_step(agent: AgentSpec) -> SlicedStep:
    """Make `train_step` in pieces: one after another, they compute what it computes.

    Args:
      agent: what learns.
    """

    def of_policy(start: LearningStart) -> Pass:
        estimate = (start.advantage, start.target)
        return policy_pass(agent, start.state, start.batch, *estimate, start.key_policy)

    def of_module(start: LearningStart) -> Pass:
        return intrinsic_pass(agent, start.state, start.batch, start.key_module)

    def begin(state: TrainState, batch: Experience) -> tuple[SlicedLearning, PassState, PassState]:
        start = begin_learning(agent, state, batch)
        state, whole = start.state, of_policy(start)
        module, inputs = PassState(module_part(state), {}), None
        if jax.tree.leaves(state.intrinsic):
            trained = of_module(start)
            module, inputs = start_pass(trained), trained.inputs
        others: Any = dict.fromkeys((*IntrinsicTrainState._fields, *PolicyState._fields))
        start = start._replace(state=state._replace(**others))
        return SlicedLearning(start, whole.inputs, inputs), start_pass(whole), module

    def policy(
        learning: SlicedLearning, done: PassState, first: Int[Array, ""], end: Int[Array, ""]
    ) -> PassState:
        whole = of_policy(learning.start)._replace(inputs=learning.policy_inputs)
        return run_slice(whole, done, first, end)

    def module(
        learning: SlicedLearning, done: PassState, first: Int[Array, ""], end: Int[Array, ""]
    ) -> PassState:
        whole = of_module(learning.start)._replace(inputs=learning.module_inputs)
        return run_slice(whole, done, first, end)

    def finish(learning: SlicedLearning, policy: PassState, module: PassState) -> TrainResult:
        start = learning.start
        learned, terms = finish_policy_pass(agent, policy, start.state.iteration)
        terms |= mean_metrics(module.metrics)
        return finish_learning(start, learned, module.carry, terms)

    return SlicedStep(begin, policy, module, finish)
