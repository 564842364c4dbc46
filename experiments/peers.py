"""python -m experiments.peers SCRIPT.py peer=cleanrl seed=0: other people's RND on our task.

Runs a training script of theirs, read from a file, on MountainCar with reward only at the goal,
as our pools make it. Its training code runs unchanged; what stands in for Atari is ours: the
environments, the networks (for vectors, 64 wide), the size of a frame, the log. Of its settings
num_envs is 32, as ours, and CleanRL initialises its normalisation for one rollout, not for 50;
settings= says others. Leaves OUT/<peer>-<seed>.json (with settings in its name, if there are any),
for `experiments.explores`; episodes of the random warm-up that the scripts begin with are left out.

    peer=cleanrl      CleanRL's ppo_rnd_envpool.py (needs torch, tyro, gym)
    peer=rlexplore    RLeXplore's "3 rlexplore_with_cleanrl.py", its RND in place of its RE3
                      (needs torch, tyro, rllte-core)
"""

import ast
import hashlib
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from itertools import pairwise
from pathlib import Path
from types import CodeType
from typing import Any

from experiments.arguments import command
from experiments.config import load
from experiments.environments import make_pool
from experiments.explores import write
from experiments.options import ConfigError, option
from experiments.progress import Bars
from experiments.stand_ins import Counted, Nowhere, for_cleanrl, for_rlexplore

PEERS = {"cleanrl": "CleanRL's RND", "rlexplore": "RLeXplore's RND"}
PACKAGES = ("torch", "gym", "gymnasium", "rllte-core")
STEPS = 1_003_520
PIXELS = 84  # the side of their frames
OURS = ("seed", "total_timesteps", "cuda")  # settings that other options say


@dataclass(frozen=True)
class Options:
    """What can be chosen."""

    peer: str = option("cleanrl", "whose script it is", choices=tuple(PEERS))
    seed: int = option(0, "of the script and of the environments", low=0)
    steps: int = option(STEPS, "that the script trains for, rounded down to rollouts", low=1)
    settings: str = option(
        "", "options of the script, with commas: learning_rate=5e-4,norm_adv=false; rnd.beta=0.1"
    )
    out: str = option("runs/peers", "where the run's figures go")


class Rows(ast.NodeTransformer):
    """Frames of a script become 1 x `width`."""

    def __init__(self, width: int):
        """Two sides of a frame, one after the other, are how one is known."""
        self.width = width

    def generic_visit(self, node: ast.AST) -> ast.AST:
        several = getattr(node, "args", None) or getattr(node, "elts", None)
        if isinstance(several, list):
            side = [isinstance(x, ast.Constant) and x.value == PIXELS for x in several]
            for k, both in enumerate(pairwise(side)):
                if all(both):
                    several[k : k + 2] = [ast.Constant(1), ast.Constant(self.width)]
                    break
        return super().generic_visit(node)


def adapted(script: str, ours: dict[str, Any], width: int) -> CodeType:
    """The code of a script in which names of ours win over its definitions and imports.

    Raises:
      ConfigError: it does not have one of these names, so that it is another script.

    >>> code = adapted("def make(): return 1\\nx = make() + sum((84, 84))", {"make": int}, 2)
    >>> names = {"make": int}
    >>> exec(code, names)
    >>> names["x"]
    3
    """
    found: set[str] = set()

    def ours_wins(name: str) -> bool:
        if name in ours:
            found.add(name)
        return name in ours

    def kept(statements: list[ast.stmt]) -> Iterator[ast.stmt]:
        for node in statements:
            if isinstance(node, ast.Import | ast.ImportFrom):
                bound = lambda alias: alias.asname or alias.name.partition(".")[0]
                node.names = [alias for alias in node.names if not ours_wins(bound(alias))]
                if not node.names:
                    continue
            elif isinstance(node, ast.ClassDef | ast.FunctionDef) and ours_wins(node.name):
                continue
            yield node

    tree = ast.parse(script)
    tree.body = list(kept(tree.body))
    if lacking := sorted(set(ours) - found):
        raise ConfigError(f"this is another script: it has no {', '.join(lacking)}")
    return compile(ast.fix_missing_locations(Rows(width).visit(tree)), "<peer>", "exec")


def settings_of(text: str, peer: str) -> dict[str, Any]:
    """The settings that a text names.

    Raises:
      ConfigError: one has no value, or is not the script's to take.

    >>> settings_of("gamma=0.9,norm_adv=false,rnd.rwd_norm_type=rms", "rlexplore")
    {'gamma': 0.9, 'norm_adv': False, 'rnd.rwd_norm_type': 'rms'}
    """
    found: dict[str, Any] = {}
    for item in filter(None, text.split(",")):
        name, equals, value = item.partition("=")
        if not equals:
            raise ConfigError(f"settings={text}: write name=value, with commas between")
        if name in OURS or (name.startswith("rnd.") and peer != "rlexplore"):
            raise ConfigError(f"settings={text}: {name} is not a setting of peer={peer}")
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
        if name.startswith("rnd."):
            continue
        if isinstance(value, bool):
            found.append(f"--{'' if value else 'no-'}{name}")
        else:
            found += [f"--{name}", str(value)]
    return found


def provenance(script: str) -> dict[str, Any]:
    """What was run, to be known again."""
    found: dict[str, Any] = {"script_sha256": hashlib.sha256(script.encode()).hexdigest()}
    for package in PACKAGES:
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def work(places: list[Path], options: Options) -> None:
    """Run the script, and write its figures."""
    if len(places) != 1:
        raise ConfigError("give one script")
    settings = settings_of(options.settings, options.peer)
    config = load(["env=MountainCar", "algo=rnd", f"seed={options.seed}"])
    settings = {"num_envs": config.num_envs} | settings
    if options.peer == "cleanrl":
        settings = {"num_iterations_obs_norm_init": 1} | settings
    tail = f",{options.settings}" if options.settings else ""
    tail += f",steps={options.steps}" if options.steps != STEPS else ""
    script = places[0].read_text()
    make = {"cleanrl": for_cleanrl, "rlexplore": for_rlexplore}[options.peer]
    pool = make_pool(config.env, [options.seed], settings["num_envs"])
    given, begun = sys.argv, time.monotonic()
    told = {"seed": options.seed, "total_timesteps": options.steps, "cuda": False}
    try:
        with Bars() as bars:
            envs = Counted(pool, bars, options.steps)
            ours = make(envs, settings, options.seed) | {"SummaryWriter": Nowhere}
            code = adapted(script, ours, pool.shape[0])
            names = {"__name__": "__main__", "__file__": str(places[0]), "print": lambda *a, **k: 0}
            sys.argv = [places[0].name, *flags(told | settings)]
            exec(code, ours | names)
    except ImportError as error:
        raise ConfigError(f"peer={options.peer} needs what is not installed: {error}") from None
    finally:
        sys.argv = given
        pool.close()
    batch = settings["num_envs"] * settings.get("num_steps", 128)
    summary = envs.summary(options.seed, options.steps // batch * batch)
    summary |= {"wall_seconds": round(time.monotonic() - begun, 1)} | provenance(script)
    name = f"{config.env.name}/{PEERS[options.peer]}/{options.seed}{tail}"
    out = Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    write({name: summary}, out / f"{options.peer}-{options.seed}{tail.replace('/', '_')}.json")
    print(f"{name}: {summary}")


def main(arguments: list[str]) -> int:
    """The command."""
    return command(str(__doc__), Options, work, arguments)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
