"""Another project's training script, adapted in memory to run on our task."""

import ast
import hashlib
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from itertools import pairwise
from pathlib import Path
from types import CodeType
from typing import Any

from ...config.compose import load_config
from ...environments.pools import make_pool
from ...reporting.seed_table import write_summaries
from ...system.display import ProgressBars
from ...system.errors import ConfigError
from .pure_jax import compare_speed
from .stand_ins import EpisodeCountingEnv, NullWriter, cleanrl_adapter, rlexplore_adapter

PEERS = {"cleanrl": "CleanRL's RND", "rlexplore": "RLeXplore's RND"}
PACKAGES = ("torch", "gym", "gymnasium", "rllte-core")
STEPS = 1_003_520
PIXELS = 84  # the side of their frames
OURS = ("seed", "total_timesteps", "cuda")  # settings that other options set


class FrameShapeRewriter(ast.NodeTransformer):
    """A transformer of a syntax tree that changes the frames of a script to 1 x `width`."""

    def __init__(self, width: int):
        """Store the width. Two adjacent sides of a frame (`PIXELS`) become 1 and `width`."""
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


def adapt_script(script: str, ours: dict[str, Any], width: int) -> CodeType:
    r"""Compile a script in which our objects replace its definitions and imports.

    Args:
      script: the text of the script.
      ours: our objects, by the name that they replace.
      width: the width of a frame, which becomes 1 x `width`.

    Raises:
      ConfigError: the script lacks one of these names, so that it is another script.

    >>> code = adapt_script("def make(): return 1\nx = make() + sum((84, 84))", {"make": int}, 2)
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
    return compile(
        ast.fix_missing_locations(FrameShapeRewriter(width).visit(tree)), "<peer>", "exec"
    )


def parse_settings(text: str, peer: str) -> dict[str, Any]:
    """Parse settings of the form `name=value,name=value`.

    Raises:
      ConfigError: a setting has no value, or is not a setting of the script.

    >>> parse_settings("gamma=0.9,norm_adv=false,rnd.rwd_norm_type=rms", "rlexplore")
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


def command_flags(settings: dict[str, Any]) -> list[str]:
    """Format settings as options for the command lines of the scripts.

    >>> command_flags({"gamma": 0.9, "norm_adv": False, "rnd.beta": 2})
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
    """Return the digest of the script and the versions of its packages."""
    found: dict[str, Any] = {"script_sha256": hashlib.sha256(script.encode()).hexdigest()}
    for package in PACKAGES:
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def run_peer(
    script_path: Path, peer: str, seed: int, steps: int, settings_text: str, out: Path
) -> None:
    """Run a script on our task, and write its figures; of PureJaxRL's, its speed beside ours.

    Args:
      script_path: the file of the script.
      peer: a key of `PEERS`.
      seed: the seed of the script and of the environments.
      steps: the steps that the script trains for, rounded down to rollouts.
      settings_text: options of the script, see `parse_settings`.
      out: the directory of the figures.

    Raises:
      ConfigError: a setting is wrong, the file is another script, or a package that the script
        needs is not installed.
    """
    settings = parse_settings(settings_text, peer)
    if peer == "purejaxrl":
        try:
            compare_speed(script_path.read_text(), steps, settings, adapt_script, out)
        except ImportError as error:
            raise ConfigError(f"peer={peer} needs what is not installed: {error}") from None
        return
    config = load_config(["env=MountainCar", "algo=rnd", f"seed={seed}"])
    settings = {"num_envs": config.num_envs} | settings
    if peer == "cleanrl":
        settings = {"num_iterations_obs_norm_init": 1} | settings
    tail = f",{settings_text}" if settings_text else ""
    tail += f",steps={steps}" if steps != STEPS else ""
    script = script_path.read_text()
    adapter = {"cleanrl": cleanrl_adapter, "rlexplore": rlexplore_adapter}[peer]
    pool = make_pool(config.env, [seed], settings["num_envs"])
    before, begun = sys.argv, time.monotonic()
    own = {"seed": seed, "total_timesteps": steps, "cuda": False}
    try:
        with ProgressBars() as bars:
            envs = EpisodeCountingEnv(pool, bars, steps)
            ours = adapter(envs, settings, seed) | {"SummaryWriter": NullWriter}
            code = adapt_script(script, ours, pool.shape[0])
            names = {"__name__": "__main__", "__file__": str(script_path)}
            names_of_ours: dict[str, Any] = ours | names | {"print": lambda *a, **k: 0}
            sys.argv = [script_path.name, *command_flags(own | settings)]
            exec(code, names_of_ours)
    except ImportError as error:
        raise ConfigError(f"peer={peer} needs what is not installed: {error}") from None
    finally:
        sys.argv = before
        pool.close()
    batch = settings["num_envs"] * settings.get("num_steps", 128)
    summary = envs.summary(seed, steps // batch * batch)
    summary |= {"wall_seconds": round(time.monotonic() - begun, 1)} | provenance(script)
    name = f"{config.env.name}/{PEERS[peer]}/{seed}{tail}"
    out.mkdir(parents=True, exist_ok=True)
    file = out / f"{peer}-{seed}{tail.replace('/', '_')}.json"
    write_summaries({name: summary}, file)
    print(f"{name}: {summary}")
