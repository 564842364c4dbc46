"""What is to be known on a GPU, in order of worth. Nothing here starts jax."""

from typing import NamedTuple

GAME = ("env=Venture", "algo=snd_std")
THREADS = "env.options.num_threads=8"  # half of the cores of the machine measured before
JAX_SIZES = ("num_envs=1024", "num_seeds=32")


class Step(NamedTuple):
    """A measurement.

    Attributes:
      name: of its file.
      about: what it is, for the page.
      share: of the suite's time that it may take.
      kind: "numbers", "pool" or "rate".
      options: of the run whose iterations are timed.
      learner: "whole" or "sliced"; None: as a run chooses.
      groups: the number of pools; None: as a run chooses.
    """

    name: str
    about: str
    share: float
    kind: str = "rate"
    options: tuple[str, ...] = ()
    learner: str | None = None
    groups: int | None = None

    @property
    def of_game(self) -> bool:
        """Return whether it times the game that the pools of random actions play."""
        return self.options[:1] == GAME[:1]

    @property
    def seeds(self) -> int:
        """Return the number of agents that are trained at once."""
        given = [one for one in self.options if one.startswith("num_seeds=")]
        return int(given[-1].partition("=")[2]) if given else 1


def game_step(
    name: str, about: str, *options: str, learner: str | None = None, groups: int | None = None
) -> Step:
    """Return the step that times whole iterations of the game.

    Args:
      name: of its file.
      about: what it is.
      *options: beside those of the game.
      learner: see `Step`.
      groups: see `Step`.
    """
    return Step(name, about, 0.12, "rate", (*GAME, *options), learner, groups)


CAR = ("env=MountainCar", "env.suite=gymnax", "algo=snd_vic", *JAX_SIZES)
SEA = ("env=gymnax", "env.id=DeepSea-bsuite", "algo=rnd", *JAX_SIZES)
STEPS = [
    Step("numbers", "differences from float32 on a CPU", 0.25, "numbers"),
    Step("pool", "the pools with random actions", 0.05, "pool", GAME),
    game_step("in_turn", "collecting and learning in turn", learner="whole"),
    game_step("module_beside", "the module beside the next rollout", learner="sliced"),
    game_step("overlap", "overlap=1", "overlap=1", learner="sliced"),
    game_step("overlap_512", "overlap=1, 512 environments", "overlap=1", "num_envs=512"),
    game_step("overlap_one_pool", "overlap=1, one pool", "overlap=1", groups=1),
    game_step("overlap_threads", "overlap=1, 8 threads a pool", "overlap=1", THREADS),
    game_step("overlap_seeds", "overlap=1, four seeds", "overlap=1", "num_seeds=4"),
    game_step("overlap_float32", "overlap=1, float32", "overlap=1", "precision=float32"),
    game_step("overlap_bf16", "overlap=1, bf16", "overlap=1", "precision=bf16"),
    Step("mountaincar", "MountainCar in JAX, 32 seeds x 1,024", 0.1, "rate", CAR),
    Step("deepsea", "DeepSea in JAX, 32 seeds x 1,024", 0.1, "rate", SEA),
]
