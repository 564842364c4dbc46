"""The placement of a run with seeds and environments sharded over several devices.

There is one mesh. Its axis `seeds` divides agents and its axis `envs` divides environments, over
the devices of all hosts of the run (jax.distributed). Every host steps its part of the environments
and all hosts run the same computations; data to be written are gathered on all hosts, and the
first host writes them.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from sndjax import ActorMemory, Experience

from ..config.schema import Config
from ..system.errors import ConfigError
from .placement import CPU_DEVICES, SINGLE_DEVICE, SingleDevice, acts_apart, assert_equal_on_hosts
from .recorder import Opening, Record, Recorded, Recorder


class DeviceMesh(SingleDevice):
    """The placement of seeds and environments on a mesh of several devices."""

    def __init__(
        self,
        num_seeds: int,
        num_envs: int,
        devices: Sequence[jax.Device] | None = None,
        acting: SingleDevice | None = None,
    ):
        """Create the mesh.

        Args:
          num_seeds: the number of seeds of the run.
          num_envs: the number of environments of each seed.
          devices: of all hosts; None: all there are.
          acting: the placement of policies that act, if it is another one.

        Raises:
          ConfigError: the environments cannot be divided among the devices.
        """
        super().__init__(acting=acting)
        devices = jax.devices() if devices is None else devices
        self.hosts, own = jax.process_count(), len(devices) // jax.process_count()
        self.is_leader = jax.process_index() == 0
        seeds = math.gcd(num_seeds, own)
        across = self.hosts * own // seeds
        if num_envs % across:
            raise ConfigError(
                f"num_envs={num_envs} cannot be divided among {self.hosts * own} devices: with "
                f"num_seeds={num_seeds} it must be a multiple of {across} "
                "(or show fewer devices: CUDA_VISIBLE_DEVICES=0)"
            )
        order = sorted(devices, key=lambda device: (device.process_index, device.id))
        grid = np.array(order).reshape(self.hosts, seeds, own // seeds)
        self.mesh = Mesh(grid.transpose(1, 0, 2).reshape(seeds, across), ("seeds", "envs"))
        self.axis = "seeds"

    def sharding(self, *axes: str | None) -> NamedSharding:
        """Return the sharding of arrays whose leading axes are divided over these mesh axes."""
        return NamedSharding(self.mesh, PartitionSpec(*axes))

    def shard_rows(self, rows: Any) -> Any:
        constrain = jax.lax.with_sharding_constraint
        return jax.tree.map(lambda x: constrain(x, self.sharding("envs")), rows)

    def local_env_slice(self, num_envs: int) -> slice:
        part, own = num_envs // self.hosts, jax.process_index()
        return slice(own * part, (own + 1) * part)

    def put_part(self, array: Any, *axes: str | None) -> Any:
        """Return the sharded array over all devices of which this host has the rows `array`."""
        if isinstance(array, jax.Array):  # on the mesh already, or where policies act apart
            return array if self.hosts > 1 else jax.device_put(array, self.sharding(*axes))
        return jax.make_array_from_process_local_data(self.sharding(*axes), array)

    def put(self, tree: Any) -> Any:
        return tree  # what acts is on the mesh already

    def compile_recorder(self, recorder: Recorder) -> Recorder:
        rows, columns = self.sharding("seeds", "envs"), self.sharding("seeds", None, "envs")
        memory = self.memory_shardings()
        record = Record(memory=memory, **dict.fromkeys(Record._fields[1:], columns))
        opening = Opening(history=columns, hidden=rows)
        joined = dict.fromkeys(Recorded._fields, columns) | {"hidden": rows}
        own: Any = (rows, rows)
        open_record = jax.jit(
            recorder.open,
            donate_argnums=0,
            in_shardings=(memory, *own),
            out_shardings=(record, opening),
        )
        act_record = jax.jit(
            recorder.act,
            donate_argnums=1,
            in_shardings=(self.sharding("seeds"), record, *own, *2 * [self.sharding()]),
            out_shardings=(rows, record),
        )
        put = lambda x: self.put_part(x, "seeds", "envs")

        def act(actor: Any, record: Record, frame: Any, first: Any, t: Any, draw: Any) -> Any:
            return act_record(actor, record, put(frame), put(first), t, draw)

        return Recorder(
            open=lambda memory, frame, first: open_record(memory, put(frame), put(first)),
            act=act,
            join=jax.jit(recorder.join, out_shardings=Recorded(**joined)),
        )

    def memory_shardings(self) -> ActorMemory:
        """Return the sharding of what policies remember."""
        window: Any = self.sharding("seeds", None, "envs")
        hidden: Any = self.sharding("seeds", "envs")
        return ActorMemory(window=window, hidden=hidden)

    def put_memory(self, memory: ActorMemory) -> ActorMemory:
        window = self.put_part(memory.window, "seeds", None, "envs")
        return ActorMemory(
            window, jax.tree.map(lambda x: self.put_part(x, "seeds", "envs"), memory.hidden)
        )

    def local_rows(self, array: Any) -> np.ndarray:
        local = multihost_utils.global_array_to_host_local_array
        return np.asarray(local(array, self.mesh, PartitionSpec("seeds", "envs")))

    def compile_train_step(self, function: Callable[..., Any]) -> Any:
        states = self.sharding("seeds")
        return jax.jit(
            function,
            donate_argnums=0,
            in_shardings=(states, self.batch_shardings()),
            out_shardings=(states, self.sharding(), self.sharding()),
        )

    def compile_iterations(self, function: Callable[..., Any]) -> Any:
        states, whole = self.sharding("seeds"), self.sharding()
        return jax.jit(
            function,
            donate_argnums=0,
            in_shardings=(states, whole),
            out_shardings=(states, whole, self.batch_shardings()),
        )

    def batch_shardings(self) -> Any:
        """Return the sharding of every field of an `Experience`."""
        rows = self.sharding("seeds", None, "envs")
        fields: Any = dict.fromkeys(Experience._fields, rows)
        return Experience(**fields | {"hidden": self.sharding("seeds", "envs")})

    def put_batch(self, batch: Experience) -> Experience:
        rows = jax.tree.map(self.put_rows, batch._replace(hidden=None))
        hidden = jax.tree.map(lambda x: self.put_part(x, "seeds", "envs"), batch.hidden)
        return rows._replace(hidden=hidden)

    def put_rows(self, rows: Any) -> Any:
        """Return the sharded array over all devices of this host's rows [S, T, n, ...]."""
        return self.put_part(rows, "seeds", None, "envs")

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
        return jax.tree.map(np.array, self.to_host(jax.tree.map(self.put_rows, tree)))

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
    """Return the placement of a configuration on the available devices.

    With overlap=1 and two devices or more, the last one acts, and as many of the others learn as
    seeds and environments can be divided among, without waiting for each other. Environments in
    JAX act and learn in one program, on the same devices.

    Raises:
      ConfigError: the environments cannot be divided among the devices.
    """
    cores = getattr(jax.config, CPU_DEVICES)  # set by `use_cores`: see `place_on_cores`
    on_cores = jax.default_backend() == "cpu" and jax.device_count() == cores
    if jax.device_count() == 1 or (on_cores and not acts_apart(config)):
        return SINGLE_DEVICE
    if not acts_apart(config):
        return DeviceMesh(config.num_seeds, config.num_envs)
    *others, last = jax.devices()
    acting = SingleDevice(last)
    count = 1 if on_cores else most_devices(config.num_seeds, config.num_envs, len(others))
    if count == 1:
        return SingleDevice(others[0], acting)
    return DeviceMesh(config.num_seeds, config.num_envs, others[:count], acting)


def most_devices(num_seeds: int, num_envs: int, there: int) -> int:
    """Return the largest number of devices that seeds and environments can be divided among.

    Args:
      num_seeds: the number of seeds of the run.
      num_envs: the number of environments of each seed.
      there: how many devices there are.

    >>> most_devices(1, 128, 3), most_devices(2, 128, 7), most_devices(3, 128, 3)
    (2, 4, 3)
    """
    fits = lambda count: num_envs % (count // math.gcd(num_seeds, count)) == 0
    return max(count for count in range(1, there + 1) if fits(count))
