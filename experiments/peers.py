"""python -m experiments.peers SCRIPT.py peer=cleanrl seed=0: other people's RND on our task.

Runs a training script of theirs, read from a file, on MountainCar with reward only at the goal,
as our pools make it. The training is theirs to the letter; what Atari asks for gives way: the
environments, the two networks of pixels (here of vectors, of the same form, 64 wide), the size of
a frame, and the logging. Leaves OUT/<peer>-<seed>-<settings>.json for `experiments.explores`.

    peer=cleanrl      CleanRL's ppo_rnd_envpool.py (needs torch, tyro, gym)
    peer=rlexplore    RLeXplore's "3 rlexplore_with_cleanrl.py", its RND in place of its RE3
                      (needs torch, tyro, rllte-core)
"""

import ast
import sys
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from experiments.arguments import command
from experiments.config import load
from experiments.environments import make_pool
from experiments.explores import write
from experiments.options import ConfigError, option
from experiments.progress import Bars
from experiments.stand_ins import Counted, Nowhere, for_cleanrl, for_rlexplore

PEERS = {"cleanrl": "CleanRL's RND", "rlexplore": "RLeXplore's RND"}
PIXELS = 84  # the side of their frames


@dataclass(frozen=True)
class Options:
    """What can be chosen."""

    peer: str = option("cleanrl", "whose script it is", choices=tuple(PEERS))
    seed: int = option(0, "of the script and of the environments", low=0)
    steps: int = option(1_003_520, "that the script is told to train for", low=1)
    settings: str = option(
        "", "options of the script, with commas: learning_rate=5e-4,norm_adv=false; rnd.beta=0.1"
    )
    out: str = option("runs/peers", "where the run's figures go")


class Adapted(ast.NodeTransformer):
    """A script in which names of ours win over its own, and frames are 1 x `width`."""

    def __init__(self, ours: dict[str, Any], width: int):
        """What is defined or imported under a name in `ours` is left out."""
        self.ours, self.width = ours, width

    def definition(self, node: Any) -> Any:
        return None if node.name in self.ours else self.generic_visit(node)

    visit_ClassDef = visit_FunctionDef = definition

    def imported(self, node: Any) -> Any:
        bound = lambda alias: alias.asname or alias.name.partition(".")[0]
        node.names = [alias for alias in node.names if bound(alias) not in self.ours]
        return node if node.names else None

    visit_Import = visit_ImportFrom = imported

    def generic_visit(self, node: ast.AST) -> ast.AST:
        several = getattr(node, "args", None) or getattr(node, "elts", None)
        if isinstance(several, list):
            side = [isinstance(x, ast.Constant) and x.value == PIXELS for x in several]
            for k, both in enumerate(pairwise(side)):
                if all(both):
                    several[k : k + 2] = [ast.Constant(1), ast.Constant(self.width)]
        return super().generic_visit(node)


def adapted(script: str, ours: dict[str, Any], width: int) -> Any:
    """The code of a script, adapted.

    >>> code = adapted("def make(): return 1\\nx = make() + sum((84, 84))", {"make": int}, 2)
    >>> names = {"make": int}
    >>> exec(code, names)
    >>> names["x"]
    3
    """
    tree = Adapted(ours, width).visit(ast.parse(script))
    return compile(ast.fix_missing_locations(tree), "<peer>", "exec")


def settings_of(text: str) -> dict[str, Any]:
    """The settings that a text names.

    Raises:
      ConfigError: one has no value.

    >>> settings_of("gamma=0.9,norm_adv=false,rnd.rwd_norm_type=rms")
    {'gamma': 0.9, 'norm_adv': False, 'rnd.rwd_norm_type': 'rms'}
    """
    found: dict[str, Any] = {}
    for item in filter(None, text.split(",")):
        name, equals, value = item.partition("=")
        if not equals:
            raise ConfigError(f"settings={text}: write name=value, with commas between")
        try:
            found[name] = ast.literal_eval(value.capitalize() if value.isalpha() else value)
        except (ValueError, SyntaxError):
            found[name] = value
    return found


def flags(settings: dict[str, Any]) -> list[str]:
    """Settings as the scripts' command lines take them.

    >>> flags({"gamma": 0.9, "norm_adv": False, "rnd.beta": 2})
    ['--gamma', '0.9', '--no-norm-adv']
    """
    found = []
    for key, value in settings.items():
        name = key.replace("_", "-")
        if isinstance(value, bool):
            found.append(f"--{'' if value else 'no-'}{name}")
        elif not name.startswith("rnd."):
            found += [f"--{name}", str(value)]
    return found


def work(places: list[Path], options: Options) -> None:
    """Run the script, and write its figures."""
    if len(places) != 1:
        raise ConfigError("give one script")
    settings = settings_of(options.settings)
    config = load(["env=MountainCar", "algo=rnd", f"seed={options.seed}"])
    base = {"seed": options.seed, "num_envs": config.num_envs, "cuda": False}
    base["total_timesteps"] = options.steps
    if options.peer == "cleanrl":
        base["num_iterations_obs_norm_init"] = 1  # 50 would be a fifth of the run
    script = places[0].read_text()
    with Bars() as bars:
        pool = make_pool(config.env, [options.seed], config.num_envs)
        envs = Counted(pool, bars, options.steps)
        try:
            make = {"cleanrl": for_cleanrl, "rlexplore": for_rlexplore}[options.peer]
            ours = make(envs, settings) | {"SummaryWriter": Nowhere}
        except ImportError as error:
            raise ConfigError(f"peer={options.peer} needs what is not installed: {error}") from None
        ours["print"] = lambda *args, **named: None
        sys.argv = [places[0].name, *flags(base | settings)]
        begun = time.monotonic()
        code = adapted(script, ours, pool.shape[0])
        exec(code, ours | {"__name__": "__main__", "__file__": str(places[0])})
    summary = envs.summary(options.seed, time.monotonic() - begun)
    tail = f",{options.settings}" if options.settings else ""
    name = f"{config.env.name}/{PEERS[options.peer]}/{options.seed}{tail}"
    file = f"{options.peer}-{options.seed}{tail.replace('/', '_')}.json"
    out = Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    write({name: summary}, out / file)
    print(f"{name}: {summary}")


def main(arguments: list[str]) -> int:
    """The command."""
    return command(str(__doc__), Options, work, arguments)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
