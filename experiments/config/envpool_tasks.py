"""The envpool tasks, and the check that a task can be trained on. Imports envpool."""

import ctypes
import importlib.util
from pathlib import Path

# Procgen's renderer needs Qt's Core and Gui and the ICU libraries that Qt needs. envpool
# does not contain them; PyQt5-Qt5 does. Loaded before envpool, in order of dependency.
QT_LIBRARIES = (
    "libicudata.so.56",
    "libicuuc.so.56",
    "libicui18n.so.56",
    "libQt5Core.so.5",
    "libQt5Gui.so.5",
)


def load_qt() -> str:
    """Load the Qt libraries from the PyPI package, if it is installed.

    Qt needs GLib and OpenGL from the system. Only Procgen needs Qt.

    Returns:
      The reason why a library could not be loaded, or "".
    """
    package = importlib.util.find_spec("PyQt5")
    if package is None:
        return "PyQt5-Qt5 is not installed; there are no wheels of it for Linux on ARM"
    for root in package.submodule_search_locations or ():
        for name in QT_LIBRARIES:
            path = Path(root) / "Qt5" / "lib" / name
            try:
                if path.is_file():
                    ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
            except OSError as error:
                return f"{error}; Qt needs Debian's libglib2.0-0 and libgl1"
    return ""


QT_MISSES = load_qt()

import envpool
import gymnasium as gym
from envpool.registration import registry

from ..system.errors import ConfigError
from .validation import unknown_name_error

FAMILIES = {"envpool.atari": "atari", "envpool.procgen": "procgen"}


def family_of(task: str) -> str:
    """Return the config family of an envpool task.

    Raises:
      ConfigError: the task does not exist or cannot be made, its actions are not one discrete
        choice, or its levels are broken.
    """
    known = envpool.list_all_envs()
    if task not in known:
        raise unknown_name_error("envpool task", task, known)
    if task.startswith("MiniGrid-MultiRoom"):
        raise ConfigError(
            f"env.id={task}: envpool puts up to a third of these doors into corners, and levels "
            f"cannot be solved; take minigrid's own, env=MiniGrid env.id=minigrid:{task}"
        )
    try:
        space = envpool.make_spec(task).action_space
    except Exception as error:  # for example, a task whose files are missing
        cause = (str(error) or type(error).__name__).splitlines()[0]
        if QT_MISSES and registry.specs[task][0] == "envpool.procgen":
            cause = QT_MISSES
        raise ConfigError(f"envpool cannot make {task}: {cause}") from None
    if not isinstance(space, gym.spaces.Discrete):
        raise ConfigError(
            f"env.id={task} has {type(space).__name__} actions of shape {space.shape}; "
            "only tasks with discrete actions can be trained on"
        )
    return FAMILIES.get(registry.specs[task][0], "plain")
