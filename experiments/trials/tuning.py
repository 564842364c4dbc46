"""The search for a method's settings on a task: all on one seed, the best of them on more."""

from collections.abc import Callable
from functools import lru_cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import qmc

from ..config.compose import load_config
from .population import Curve, Population
from .protocol import Method, Protocol, Task

TOGETHER = 4  # agents in one program
Report = Callable[[int], None]  # called with the number of agents that were trained
DRAW_SEED = 0  # of the settings, the same for all methods
LAST = 0.2  # the part of a run, its last, whose episodes count


class Setting(NamedTuple):
    """A setting of a method: numbers, which a program takes as arguments, and choices."""

    numbers: dict[str, float]
    choices: dict[str, Any]


class Scores(NamedTuple):
    """How good agents were, float[S].

    Attributes:
      solved: the share of solved episodes among those that ended in the run's last fifth.
      coverage: the distinct places that were visited in the whole run.
      progress: the mean progress of all episodes.
    """

    solved: np.ndarray
    coverage: np.ndarray
    progress: np.ndarray


def score_curve(curve: Curve) -> Scores:
    """Return the scores of a population.

    Args:
      curve: of its whole training.
    """
    begin = int((1 - LAST) * curve.episodes.shape[1])
    ended = curve.episodes[:, begin:].sum(1)
    solved = curve.solved[:, begin:].sum(1) / np.maximum(ended, 1)
    return Scores(solved, curve.coverage[:, -1], curve.progress[:, -1])


def draw_settings(method: Method, count: int) -> list[Setting]:
    """Return settings that cover a method's ranges evenly (a scrambled Sobol sequence).

    Args:
      method: whose numbers and choices are drawn; every combination of choices as often.
      count: the number of settings.
    """
    names = list(method.numbers)
    sampler = qmc.Sobol(len(names), rng=np.random.default_rng(DRAW_SEED))
    points = sampler.random(count)
    low, high = (np.log([ends[i] for ends in method.numbers.values()]) for i in (0, 1))
    values = np.exp(low + points * (high - low))
    combinations = [
        dict(zip(method.choices, chosen, strict=True))
        for chosen in product(*method.choices.values())
    ]
    return [
        Setting(dict(zip(names, map(float, row), strict=True)), combinations[i % len(combinations)])
        for i, row in enumerate(values)
    ]


def run_arguments(
    protocol: Protocol, task: Task, method: Method, choices: dict[str, Any], agents: int
) -> list[str]:
    """Return the arguments of `sndjax` for agents of a row, without their numbers.

    Args:
      protocol: of the trial.
      task: of the row.
      method: of the row.
      choices: of the setting.
      agents: their number.
    """
    chosen = [f"{name}={value}" for name, value in choices.items()]
    steps = [f"total_steps={task.steps}", f"num_seeds={agents}"]
    return [*task.arguments, *protocol.common, *method.arguments, *chosen, *steps]


@lru_cache(maxsize=8)
def make_population(arguments: tuple[str, ...]) -> Population:
    """Return the agents of a command line; they are compiled once for a search and its row.

    Args:
      arguments: of `sndjax`.
    """
    return Population(load_config(list(arguments)))


def train_settings(
    protocol: Protocol,
    task: Task,
    method: Method,
    agents: list[tuple[Setting, int]],
    report: Report = lambda agents: None,
) -> Curve:
    """Train agents of settings and seeds, `TOGETHER` of the same choices at once.

    Args:
      protocol: of the trial.
      task: of the row.
      method: of the row.
      agents: the setting and the seed of each.
      report: called after each program.

    Returns:
      Their curves, in the order of `agents`.
    """
    groups: dict[str, list[int]] = {}
    for i, (setting, _) in enumerate(agents):
        groups.setdefault(str(setting.choices), []).append(i)
    curves, order = [], []
    for group in groups.values():
        for start in range(0, len(group), TOGETHER):
            part = group[start : start + TOGETHER]
            order += part
            padded = part + part[-1:] * (TOGETHER - len(part))  # a program is for so many
            own, seeds = zip(*(agents[i] for i in padded), strict=True)
            arguments = run_arguments(protocol, task, method, own[0].choices, TOGETHER)
            numbers = {name: [setting.numbers[name] for setting in own] for name in own[0].numbers}
            population = make_population(tuple(arguments))
            _, curve = population.train(population.start(list(seeds)), numbers)
            curves.append(Curve(*(field[: len(part)] for field in curve)))
            report(len(part))
    places = np.argsort(order)
    return Curve(*(np.concatenate(fields)[places] for fields in zip(*curves, strict=True)))


class Tuned(NamedTuple):
    """The result of a search.

    Attributes:
      setting: the best of the finalists.
      tried: a row for every setting: its numbers and choices, the scores on each seed.
    """

    setting: Setting
    tried: list[dict[str, Any]]


def rank(tried: list[dict[str, Any]]) -> list[int]:
    """Return the indices of settings, the best first: by solved episodes, then by coverage.

    Args:
      tried: see `Tuned`.
    """
    mean = lambda row, name: float(np.mean(row[name]))
    return sorted(
        range(len(tried)),
        key=lambda i: (-mean(tried[i], "solved"), -mean(tried[i], "coverage"), i),
    )


def tune(
    protocol: Protocol, task: Task, method: Method, report: Report = lambda agents: None
) -> Tuned:
    """Search for the settings of a row.

    Args:
      protocol: of the trial.
      task: of the row.
      method: of the row.
      report: called after each program.
    """
    settings = draw_settings(method, protocol.settings)
    tried: list[dict[str, Any]] = [
        {**setting.numbers, **setting.choices, "solved": [], "coverage": []} for setting in settings
    ]

    def try_all(which: list[int], seeds: list[int]) -> None:
        agents = [(i, seed) for i in which for seed in seeds]
        pairs = [(settings[i], seed) for i, seed in agents]
        curve = train_settings(protocol, task, method, pairs, report)
        scores = score_curve(curve)
        for (i, _), solved, coverage in zip(agents, scores.solved, scores.coverage, strict=True):
            tried[i]["solved"].append(round(float(solved), 4))
            tried[i]["coverage"].append(int(coverage))

    first, *others = protocol.tuning_seeds
    try_all(list(range(len(settings))), [first])
    finalists = rank(tried)[: protocol.finalists]
    try_all(finalists, others)
    best = rank([tried[i] for i in finalists])[0]
    return Tuned(settings[finalists[best]], tried)
