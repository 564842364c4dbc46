"""Where a run computes: one device, or seeds and environments laid over several.

One mesh: its axis `seeds` holds agents and `envs` holds environments, of this host and, where a
run has several (jax.distributed), of all. Every host steps its own environments and all do the
same computations; what is written down is gathered everywhere, and written by the first.
"""

import math
import os
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from experiments.options import Config, ConfigError

WHO = ("JAX_NUM_PROCESSES", "JAX_PROCESS_ID")


def join_hosts() -> None:
    """Meet the other processes of the run: by the cluster's own account, or by what ours says.

    Raises:
      ConfigError: neither says who they are, or they do not come.
    """
    count, own = (os.environ.get(name) for name in WHO)
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


class OneDevice:
    """Everything where jax puts it."""

    hosts, leads = 1, True
    axis: str | None = None  # the mesh's axis of seeds

    def spread(self, rows: Any) -> Any:
        """The rows [B, ...] of a minibatch, where each is computed."""
        return rows

    def envs(self, num_envs: int) -> slice:
        """Those of all environments that this host steps."""
        return slice(0, num_envs)

    def act(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Compile `sndjax.act` of all seeds."""
        return jax.jit(function)

    def learn(self, function: Callable[..., Any]) -> Any:
        """Compile `train_step` of all seeds; it uses the state's memory again."""
        return jax.jit(function, donate_argnums=0)

    def frames(self, frame: np.ndarray) -> Any:
        """Frames [S, n, ...] of this host's environments, where they are learned from."""
        return jax.device_put(frame)

    def batch(self, batch: Any) -> Any:
        """A batch of this host's environments as `learn` takes it."""
        return batch

    def states(self, states: Any) -> Any:
        """The states of all seeds, where they are learned."""
        return states

    def everywhere(self, tree: Any) -> Any:
        """Arrays [S, T, n, ...] of this host's environments, those of all hosts side by side."""
        return tree

    def whole(self, tree: Any) -> Any:
        """A state, so that this host can read all of it."""
        return tree

    def any(self, said: bool) -> bool:
        """Whether any host says so."""
        return said

    def meet(self, where: str) -> None:
        """Wait until every host is here."""

    def groups(self, wanted: int, num_envs: int) -> int:
        """Into how many pools the environments go, if so many can be laid out."""
        return wanted

    def agree(self, value: int, otherwise: str) -> None:
        """Go on if all hosts have the same value.

        Raises:
          ConfigError: they have not.
        """


ONE_DEVICE = OneDevice()


class Devices(OneDevice):
    """A mesh of several devices."""

    def __init__(self, num_seeds: int, num_envs: int):
        """Lay them out.

        Raises:
          ConfigError: the environments cannot be divided among them.
        """
        self.hosts, own = jax.process_count(), jax.local_device_count()
        self.leads = jax.process_index() == 0
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

    def placed(self, *axes: str | None) -> NamedSharding:
        """Arrays whose axes are laid over these of the mesh."""
        return NamedSharding(self.mesh, PartitionSpec(*axes))

    def spread(self, rows: Any) -> Any:
        return jax.tree.map(
            lambda x: jax.lax.with_sharding_constraint(x, self.placed("envs")), rows
        )

    def envs(self, num_envs: int) -> slice:
        part, own = num_envs // self.hosts, jax.process_index()
        return slice(own * part, (own + 1) * part)

    def put(self, array: Any, *axes: str | None) -> Any:
        """An array of this host's rows as its part of one that is laid over all devices."""
        if isinstance(array, jax.Array):
            return array
        return jax.make_array_from_process_local_data(self.placed(*axes), array)

    def frames(self, frame: np.ndarray) -> Any:
        return self.put(frame, "seeds", "envs")

    def act(self, function: Callable[..., Any]) -> Callable[..., Any]:
        rows, stacks = self.placed("seeds", "envs"), self.placed("seeds", None, "envs")
        compiled = jax.jit(
            function,
            in_shardings=(self.placed("seeds"), stacks, rows, rows, self.placed()),
            out_shardings=(rows, stacks),
        )

        def act(actor, window, frame, first, step):
            window = self.put(window, "seeds", None, "envs")
            frame, first = (self.put(x, "seeds", "envs") for x in (frame, first))
            decision, window = compiled(actor, window, frame, first, step)
            local = multihost_utils.global_array_to_host_local_array
            own = local(decision, self.mesh, PartitionSpec("seeds", "envs"))
            return jax.tree.map(np.asarray, own), window

        return act

    def learn(self, function: Callable[..., Any]) -> Any:
        states, rows = self.placed("seeds"), self.placed("seeds", None, "envs")
        return jax.jit(
            function,
            donate_argnums=0,
            in_shardings=(states, rows),
            out_shardings=(states, self.placed(), self.placed()),
        )

    def batch(self, batch: Any) -> Any:
        return jax.tree.map(lambda x: self.put(x, "seeds", None, "envs"), batch)

    def states(self, states: Any) -> Any:
        def laid(x):
            if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
                return jax.random.wrap_key_data(laid(jax.random.key_data(x)))
            value = np.asarray(x)
            return jax.make_array_from_callback(
                value.shape, self.placed("seeds"), value.__getitem__
            )

        return jax.tree.map(laid, states)

    def everywhere(self, tree: Any) -> Any:
        if self.hosts == 1:
            return tree
        return jax.tree.map(np.array, self.whole(self.batch(tree)))

    def whole(self, tree: Any) -> Any:
        if self.hosts == 1:
            return tree
        return jax.jit(lambda x: x, out_shardings=self.placed())(tree)

    def any(self, said: bool) -> bool:
        if self.hosts == 1:
            return said
        return bool(np.any(multihost_utils.process_allgather(np.array(said))))

    def groups(self, wanted: int, num_envs: int) -> int:
        across = self.mesh.shape["envs"]
        return wanted if self.hosts == 1 and num_envs % (wanted * across) == 0 else 1

    def agree(self, value: int, otherwise: str) -> None:
        if self.hosts > 1:
            agree(value, otherwise)

    def meet(self, where: str) -> None:
        if self.hosts > 1:
            multihost_utils.sync_global_devices(where)


def agree(value: int, otherwise: str) -> None:
    """Go on if all processes have the same value.

    Raises:
      ConfigError: they have not.
    """
    values = np.ravel(multihost_utils.process_allgather(np.array(value))).tolist()
    if len(set(values)) > 1:
        raise ConfigError(f"distributed=true: some hosts {otherwise}: {values}")


def layout(config: Config) -> OneDevice:
    """How a run is laid over the devices there are.

    Raises:
      ConfigError: it cannot be.
    """
    if jax.device_count() == 1:
        return ONE_DEVICE
    return Devices(config.num_seeds, config.num_envs)
