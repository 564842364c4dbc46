"""The placement of a run on one device, and what all hosts of a run do together."""

import os
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

from sndjax import ActorMemory

from ..config.jax_suites import JAX_SUITES
from ..config.schema import Config
from ..system.errors import ConfigError
from .recorder import Recorder

CPU_DEVICES = "jax_num_cpu_devices"  # jax declares no such attribute
HOST_VARIABLES = ("JAX_NUM_PROCESSES", "JAX_PROCESS_ID")


def join_hosts() -> None:
    """Connect to the other processes of the run.

    The number of processes and the index of this process are read from the cluster's environment
    variables, or from JAX_NUM_PROCESSES and JAX_PROCESS_ID.

    Raises:
      ConfigError: neither is set, or the other processes do not connect.
    """
    count, own = (os.environ.get(name) for name in HOST_VARIABLES)
    try:
        jax.distributed.initialize(
            num_processes=None if count is None else int(count),
            process_id=None if own is None else int(own),
        )
    except (ValueError, RuntimeError) as error:
        raise ConfigError(
            "distributed=true: set JAX_COORDINATOR_ADDRESS=HOST:PORT, JAX_NUM_PROCESSES and "
            f"JAX_PROCESS_ID, or run under Slurm or Open MPI ({str(error).splitlines()[0]})"
        ) from None


def assert_equal_on_hosts(value: int, otherwise: str) -> None:
    """Raise ConfigError unless all hosts call this function with the same value.

    Args:
      value: the value of this host.
      otherwise: the meaning of a difference, for the error message.

    Raises:
      ConfigError: the values differ.
    """
    values = np.ravel(multihost_utils.process_allgather(np.array(value))).tolist()
    if len(set(values)) > 1:
        raise ConfigError(f"distributed=true: some hosts {otherwise}: {values}")


class SingleDevice:
    """The placement on one device. `DeviceMesh` gives the same results on several.

    Attributes:
      acting: the placement of policies that act: this one, or that on a device of their own.
      hosts: the number of processes of the run.
      is_leader: whether this process writes the files of the run.
      axis: the name of the mesh's axis of seeds; None without a mesh.
      beside: the name of a mesh axis of two devices, of which one trains the policy and the other
        the module; None where one device does both.
    """

    hosts = 1
    is_leader = True
    axis: str | None = None
    beside: str | None = None

    def __init__(self, device: jax.Device | None = None, acting: "SingleDevice | None" = None):
        """Choose the device.

        Args:
          device: the device; None: jax's default.
          acting: the placement of policies that act, if it is another one.
        """
        self.device, self.acting = device, acting or self

    def seeds_here(self, seeds: int) -> int:
        """Return the number of seeds that a compiled function sees."""
        return seeds

    def shard_rows(self, rows: Any) -> Any:
        """Return the rows [B, ...] of a minibatch, sharded over the devices that compute them."""
        return rows

    def local_env_slice(self, num_envs: int) -> slice:
        """Return the slice of all environments that this host steps."""
        return slice(0, num_envs)

    def put(self, tree: Any) -> Any:
        """Return a tree on this device."""
        return tree if self.device is None else jax.device_put(tree, self.device)

    def compile_recorder(self, recorder: Recorder) -> Recorder:
        """Return the programs that record rollouts, jitted."""
        return Recorder(
            open=jax.jit(recorder.open, donate_argnums=0),
            act=jax.jit(recorder.act, donate_argnums=1),
            join=jax.jit(recorder.join),
        )

    def put_memory(self, memory: ActorMemory) -> ActorMemory:
        """Return the first memory of this host's environments, on the devices that act."""
        return self.put(memory)

    def local_rows(self, array: Any) -> np.ndarray:
        """Wait for an array [S, n] on the devices that act, and return this host's part."""
        return np.asarray(array)

    def compile_train_step(self, function: Callable[..., Any]) -> Any:
        """Return `train_step` of all seeds, jitted. The state is donated: its memory is reused."""
        return jax.jit(function, donate_argnums=0)

    def compile_iterations(self, function: Callable[..., Any]) -> Any:
        """Return `make_iterations` jitted. The state is donated."""
        return jax.jit(function, donate_argnums=0)

    def put_actor(self, actor: Any) -> Any:
        """Return the part of the states that acts, on the devices that act."""
        return self.acting.put(actor)

    def put_batch(self, batch: Any) -> Any:
        """Return a batch of this host's environments in the form that `train_step` expects."""
        return self.put(batch)

    def put_states(self, states: Any) -> Any:
        """Return the states of all seeds, sharded over the devices that learn."""
        return self.put(states)

    def gather_hosts(self, tree: Any) -> Any:
        """Return the arrays [S, T, n, ...] of all hosts, joined along the environments."""
        return tree

    def to_host(self, tree: Any) -> Any:
        """Return a copy of a sharded tree that this host can read completely."""
        return tree

    def any_host(self, condition: bool) -> bool:
        """Return True if the condition holds on any host."""
        return condition

    def barrier(self, name: str) -> None:
        """Wait until every host has reached the barrier of this name."""

    def num_pools(self, wanted: int, num_envs: int) -> int:
        """Return the number of pools that the environments are divided into, at most `wanted`."""
        return wanted

    def assert_equal_on_hosts(self, value: int, otherwise: str) -> None:
        """Raise ConfigError unless all hosts have the same value."""


SINGLE_DEVICE = SingleDevice()


def overlap_message(config: Config, placement: SingleDevice) -> list[str]:
    """Return the line that says which device acts while others learn; none where none does.

    Args:
      config: of the run.
      placement: of the run.
    """
    if not acts_apart(config):
        return []
    acting = placement.acting.device
    if acting is not None and placement.acting is not placement:
        return [f"overlap=1: policies act on {acting}, of {jax.device_count()} devices"]
    if jax.default_backend() != "cpu":
        return ["overlap=1: the device acts between the steps of its learning"]
    return [
        "warning: overlap=1 gains nothing here: this CPU is one device of jax, and acting waits "
        "for learning; unset XLA_FLAGS=--xla_force_host_platform_device_count=1"
    ]


def acts_apart(config: Config) -> bool:
    """Return True if policies can act on a device of their own, while the others learn."""
    return config.overlap > 0 and config.env.suite not in JAX_SUITES
