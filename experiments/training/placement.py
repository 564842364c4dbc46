"""Where a run computes: on one device, or with seeds and environments laid over several.

One mesh: its axis `seeds` holds agents and `envs` holds environments, of this host and, where a
run has several (jax.distributed), of all. Every host steps its own environments and all do the
same computations; what is written down is gathered on all hosts, and written by the first.
"""

import math
import os
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from ..config.schema import Config
from ..system.errors import ConfigError

HOST_VARIABLES = ("JAX_NUM_PROCESSES", "JAX_PROCESS_ID")


def join_hosts() -> None:
    """Connect to the other processes of the run.

    Their number and this one's place are read from the cluster's environment variables, or from
    JAX_NUM_PROCESSES and JAX_PROCESS_ID.

    Raises:
      ConfigError: neither is set, or the others do not come.
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
    """Raise unless all hosts call this with the same value.

    Args:
      value: of this host.
      otherwise: what it means if they differ, for the error.

    Raises:
      ConfigError: they differ.
    """
    values = np.ravel(multihost_utils.process_allgather(np.array(value))).tolist()
    if len(set(values)) > 1:
        raise ConfigError(f"distributed=true: some hosts {otherwise}: {values}")


class SingleDevice:
    """Places everything where jax puts it; what it computes with several devices is the same.

    Attributes:
      hosts: how many processes the run has.
      is_leader: this process writes the run.
      axis: the mesh's axis of seeds, None without a mesh.
    """

    hosts = 1
    is_leader = True
    axis: str | None = None

    def shard_rows(self, rows: Any) -> Any:
        """Return the rows [B, ...] of a minibatch, laid over the devices that compute them."""
        return rows

    def local_env_slice(self, num_envs: int) -> slice:
        """Return which of all environments this host steps."""
        return slice(0, num_envs)

    def compile_act(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return `sndjax.act` of all seeds, jitted."""
        return jax.jit(function)

    def compile_train_step(self, function: Callable[..., Any]) -> Any:
        """Return `train_step` of all seeds, jitted; it uses the state's memory again."""
        return jax.jit(function, donate_argnums=0)

    def put_frames(self, frame: np.ndarray) -> Any:
        """Copy frames [S, n, ...] of this host's environments to where they are learned from."""
        return jax.device_put(frame)

    def put_batch(self, batch: Any) -> Any:
        """Return a batch of this host's environments as `train_step` takes it."""
        return batch

    def put_states(self, states: Any) -> Any:
        """Return the states of all seeds, laid over the devices that learn."""
        return states

    def gather_hosts(self, tree: Any) -> Any:
        """Return arrays [S, T, n, ...] of this host with those of all hosts side by side."""
        return tree

    def to_host(self, tree: Any) -> Any:
        """Return a state that this host can read whole."""
        return tree

    def any_host(self, condition: bool) -> bool:
        """Return True if the condition holds on any host."""
        return condition

    def barrier(self, name: str) -> None:
        """Wait until every host has reached the barrier of this name."""

    def num_pools(self, wanted: int, num_envs: int) -> int:
        """Return into how many pools the environments go, of at most `wanted`."""
        return wanted

    def assert_equal_on_hosts(self, value: int, otherwise: str) -> None:
        """Raise ConfigError unless all hosts have the same value."""


SINGLE_DEVICE = SingleDevice()


class DeviceMesh(SingleDevice):
    """Lays seeds and environments over a mesh of several devices."""

    def __init__(self, num_seeds: int, num_envs: int):
        """Lay out the mesh.

        Raises:
          ConfigError: the environments cannot be divided among the devices.
        """
        self.hosts, own = jax.process_count(), jax.local_device_count()
        self.is_leader = jax.process_index() == 0
        seeds = math.gcd(num_seeds, own)
        across = self.hosts * own // seeds
        if num_envs % across:
            raise ConfigError(
                f"num_envs={num_envs} cannot be divided among {self.hosts * own} devices: with "
                f"num_seeds={num_seeds} it must be a multiple of {across} "
                "(or show fewer devices: CUDA_VISIBLE_DEVICES=0)"
            )
        order = sorted(jax.devices(), key=lambda device: (device.process_index, device.id))
        grid = np.array(order).reshape(self.hosts, seeds, own // seeds)
        self.mesh = Mesh(grid.transpose(1, 0, 2).reshape(seeds, across), ("seeds", "envs"))
        self.axis = "seeds"

    def sharding(self, *axes: str | None) -> NamedSharding:
        """Return the sharding of arrays whose axes are laid over these of the mesh."""
        return NamedSharding(self.mesh, PartitionSpec(*axes))

    def shard_rows(self, rows: Any) -> Any:
        constrain = jax.lax.with_sharding_constraint
        return jax.tree.map(lambda x: constrain(x, self.sharding("envs")), rows)

    def local_env_slice(self, num_envs: int) -> slice:
        part, own = num_envs // self.hosts, jax.process_index()
        return slice(own * part, (own + 1) * part)

    def put(self, array: Any, *axes: str | None) -> Any:
        """Return an array of this host's rows as its part of one that is laid over all devices."""
        if isinstance(array, jax.Array):
            return array
        return jax.make_array_from_process_local_data(self.sharding(*axes), array)

    def put_frames(self, frame: np.ndarray) -> Any:
        return self.put(frame, "seeds", "envs")

    def compile_act(self, function: Callable[..., Any]) -> Callable[..., Any]:
        rows, stacks = self.sharding("seeds", "envs"), self.sharding("seeds", None, "envs")
        compiled = jax.jit(
            function,
            in_shardings=(self.sharding("seeds"), stacks, rows, rows, self.sharding()),
            out_shardings=(rows, stacks),
        )

        def act(actor: Any, window: Any, frame: Any, first: Any, step: Any) -> Any:
            window = self.put(window, "seeds", None, "envs")
            frame, first = (self.put(x, "seeds", "envs") for x in (frame, first))
            output, window = compiled(actor, window, frame, first, step)
            local = multihost_utils.global_array_to_host_local_array
            own = local(output, self.mesh, PartitionSpec("seeds", "envs"))
            return jax.tree.map(np.asarray, own), window

        return act

    def compile_train_step(self, function: Callable[..., Any]) -> Any:
        states, rows = self.sharding("seeds"), self.sharding("seeds", None, "envs")
        return jax.jit(
            function,
            donate_argnums=0,
            in_shardings=(states, rows),
            out_shardings=(states, self.sharding(), self.sharding()),
        )

    def put_batch(self, batch: Any) -> Any:
        return jax.tree.map(lambda x: self.put(x, "seeds", None, "envs"), batch)

    def put_states(self, states: Any) -> Any:
        def laid(x: Any) -> Any:
            if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
                return jax.random.wrap_key_data(laid(jax.random.key_data(x)))
            value = np.asarray(x)
            return jax.make_array_from_callback(
                value.shape, self.sharding("seeds"), value.__getitem__
            )

        return jax.tree.map(laid, states)

    def gather_hosts(self, tree: Any) -> Any:
        if self.hosts == 1:
            return tree
        return jax.tree.map(np.array, self.to_host(self.put_batch(tree)))

    def to_host(self, tree: Any) -> Any:
        if self.hosts == 1:
            return tree
        return jax.jit(lambda x: x, out_shardings=self.sharding())(tree)

    def any_host(self, condition: bool) -> bool:
        if self.hosts == 1:
            return condition
        return bool(np.any(multihost_utils.process_allgather(np.array(condition))))

    def num_pools(self, wanted: int, num_envs: int) -> int:
        across = self.mesh.shape["envs"]
        return wanted if self.hosts == 1 and num_envs % (wanted * across) == 0 else 1

    def assert_equal_on_hosts(self, value: int, otherwise: str) -> None:
        if self.hosts > 1:
            assert_equal_on_hosts(value, otherwise)

    def barrier(self, name: str) -> None:
        if self.hosts > 1:
            multihost_utils.sync_global_devices(name)


def choose_placement(config: Config) -> SingleDevice:
    """Return how the run of a configuration is laid over the devices there are.

    Raises:
      ConfigError: it cannot be laid over them.
    """
    if jax.device_count() == 1:
        return SINGLE_DEVICE
    return DeviceMesh(config.num_seeds, config.num_envs)
