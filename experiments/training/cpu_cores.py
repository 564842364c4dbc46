"""The placement of small networks on the cores of a CPU, of which one program uses only one."""

import os
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from ..config.schema import Config
from ..environments.pool import Pool
from ..system.process import available_cores
from .network_sizes import network_sizes
from .placement import CPU_DEVICES, SingleDevice, acts_apart

MOST_CORES = 64
WIDEST = 128  # layers of networks of which one program uses only one core


def cores_for(config: Config) -> int:
    """Return the number of cores that a run of small networks can use.

    Several agents are divided among as many cores as divide their number. For a single agent with
    an intrinsic module there are two: one trains the policy, the other the module.
    """
    there = config.cores or usable_cores()
    if config.num_seeds == 1:
        return 1 if config.algo.name == "ppo" else min(there, 2)
    return max(n for n in range(1, min(there, MOST_CORES) + 1) if config.num_seeds % n == 0)


def usable_cores() -> int:
    """Return the number of cores that this process may use; a sweep divides them among its jobs."""
    given = os.environ.get("PJRT_NPROC", "")
    return int(given) if given.isdecimal() and int(given) else available_cores()


def use_cores(config: Config) -> None:
    """Let jax treat cores of this CPU as devices, unless it has started or devices were set.

    Policies that act while others learn get one more device than there are cores: acting takes
    little of a core, and waits for environments.

    Args:
      config: of the run, for its number of cores.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if config.distributed or "xla_force_host_platform_device_count" in flags:
        return
    try:
        jax.config.update(CPU_DEVICES, cores_for(config) + acts_apart(config))
    except RuntimeError:  # jax has computed already
        return


def place_on_cores(config: Config, pool: Pool, placement: SingleDevice) -> SingleDevice:
    """Return the placement on cores for vectors, where jax has them; else that on one device.

    Networks for pixels and wide ones use all cores already, within their large products. Policy and
    module of wide ones would also wait for each other for long: XLA ends a program whose devices
    meet more than 40 seconds apart.

    Args:
      config: of the run.
      pool: its environments.
      placement: the one on one device.
    """
    cores, apart = cores_for(config), placement.acting is not placement
    here = jax.default_backend() == "cpu" and jax.process_count() == 1
    if not here or pool.dtype == np.uint8 or not 1 < cores <= jax.device_count() - apart:
        return placement
    if config.num_seeds == 1 and widest_layer(config, pool) > WIDEST:
        return placement
    return CpuCores(config.num_seeds, cores, placement.acting if apart else None)


def widest_layer(config: Config, pool: Pool) -> int:
    """Return the width of the widest layer of the policy's and the module's networks."""
    sizes = [network_sizes(config, pool, part) for part in ("policy", "module")]
    return max(width for size in sizes for width in (*size.hidden, size.features))


class CpuCores(SingleDevice):
    """The placement on the cores of a CPU, each of which is a device of jax.

    Seeds are divided among them; they exchange nothing. If there is one seed, two cores compute the
    same, except that one trains the policy while the other trains the module.
    """

    def __init__(self, seeds: int, cores: int, acting: SingleDevice | None = None):
        """Create the mesh.

        Args:
          seeds: the number of seeds of the run.
          cores: the number of cores that learn.
          acting: the placement of policies that act; None: the first core.
        """
        super().__init__(acting=acting or SingleDevice(jax.devices()[0]))
        self.mesh = Mesh(np.array(jax.devices()[:cores]), ("cores",))
        self.cores = cores
        self.beside = "cores" if seeds == 1 else None
        self.spec = PartitionSpec() if seeds == 1 else PartitionSpec("cores")

    def seeds_here(self, seeds: int) -> int:
        return 1 if seeds == 1 else seeds // self.cores

    def compile_train_step(self, function: Callable[..., Any]) -> Any:
        mapped = self.on_all_cores(function, (self.spec, self.spec), self.spec)
        return jax.jit(mapped, donate_argnums=0)

    def compile_iterations(self, function: Callable[..., Any]) -> Any:
        rows = PartitionSpec(None, *self.spec)
        ins, outs = (self.spec, PartitionSpec()), (self.spec, rows, self.spec)
        return jax.jit(self.on_all_cores(function, ins, outs), donate_argnums=0)

    def on_all_cores(self, function: Callable[..., Any], ins: Any, outs: Any) -> Any:
        """Return a function that runs on every core, with its part of the arguments.

        Args:
          function: the function.
          ins: how its arguments are divided.
          outs: how its results are joined.
        """
        return jax.shard_map(
            function, mesh=self.mesh, in_specs=ins, out_specs=outs, check_vma=False
        )

    def put_batch(self, batch: Any) -> Any:
        return jax.device_put(batch, NamedSharding(self.mesh, self.spec))

    def put_states(self, states: Any) -> Any:
        return jax.device_put(states, NamedSharding(self.mesh, self.spec))
