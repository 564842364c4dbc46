"""The trial's protocol as data: tasks, methods, what is tuned, on which seeds (data/trial.yaml)."""

from pathlib import Path
from typing import Any, NamedTuple

import yaml

from ..config.validation import unknown_name_error

PROTOCOL = Path(__file__).parents[1] / "data" / "trial.yaml"


class Task(NamedTuple):
    """A task of the trial.

    Attributes:
      name: short.
      title: for tables.
      kind: whole, distractor or pixels; results are pooled over all tasks and over each kind.
      arguments: of `sndjax`, besides the common ones.
      steps: agent steps of a run.
    """

    name: str
    title: str
    kind: str
    arguments: list[str]
    steps: int


class Method(NamedTuple):
    """A method of the trial, and what is tuned of it.

    Attributes:
      name: short.
      title: for tables.
      arguments: of `sndjax`, besides the common ones.
      numbers: the lowest and the highest value by option; drawn evenly in the logarithm.
      choices: the values by option.
      stage: 1 or 2; the rows of the first are run before those of the second.
    """

    name: str
    title: str
    arguments: list[str]
    numbers: dict[str, tuple[float, float]]
    choices: dict[str, list[Any]]
    stage: int


class Protocol(NamedTuple):
    """What was decided before the first row ran.

    Attributes:
      common: arguments of all runs.
      tasks: by name.
      methods: by name.
      settings: the number of settings that each method is tuned over.
      finalists: of them that are tried on more seeds.
      tuning_seeds: the first is for all settings, the others for the finalists.
      seeds: of the rows.
      reference: the method that others are compared with.
      primary: the methods that the trial's question is asked of.
    """

    common: list[str]
    tasks: dict[str, Task]
    methods: dict[str, Method]
    settings: int
    finalists: int
    tuning_seeds: list[int]
    seeds: list[int]
    reference: str
    primary: list[str]

    @property
    def agents(self) -> int:
        """Return how many agents are trained for a row, in its search and on its seeds."""
        return self.settings + self.finalists * (len(self.tuning_seeds) - 1) + len(self.seeds)

    def rows(self) -> list[tuple[Task, Method]]:
        """Return the pairs that are run, in order: all methods of a stage and a task together."""
        rows = [(task, method) for task in self.tasks.values() for method in self.methods.values()]
        return sorted(rows, key=lambda row: row[1].stage)

    def find_task(self, name: str) -> Task:
        """Return the task of a name.

        Args:
          name: of the task.

        Raises:
          ConfigError: there is none.
        """
        if name not in self.tasks:
            raise unknown_name_error("task of the trial", name, list(self.tasks))
        return self.tasks[name]

    def find_row(self, name: str) -> tuple[Task, Method]:
        """Return the task and the method of TASK/METHOD.

        Args:
          name: of the row.

        Raises:
          ConfigError: there is no such row.
        """
        rows = {f"{task.name}/{method.name}": (task, method) for task, method in self.rows()}
        if name not in rows:
            raise unknown_name_error("row of the trial", name, list(rows))
        return rows[name]


def read_protocol(path: Path = PROTOCOL) -> Protocol:
    """Return the protocol of a file.

    Args:
      path: the file.
    """
    found = yaml.safe_load(path.read_text())
    tuned = found["tuned"]
    methods = {
        name: Method(
            name=name,
            title=row["title"],
            arguments=row["arguments"],
            numbers={
                key: tuple(ends) for key, ends in row.get("numbers", tuned["numbers"]).items()
            },
            choices=row.get("choices", tuned["choices"]),
            stage=row.get("stage", 1),
        )
        for name, row in found["methods"].items()
    }
    return Protocol(
        common=found["common"],
        tasks={name: Task(name=name, **row) for name, row in found["tasks"].items()},
        methods=methods,
        settings=found["settings"],
        finalists=found["finalists"],
        tuning_seeds=list(range(*found["tuning_seeds"])),
        seeds=list(range(*found["seeds"])),
        reference=found["reference"],
        primary=found["primary"],
    )
