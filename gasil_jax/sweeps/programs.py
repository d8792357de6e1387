"""Group runs into programs, each compiled once, and keep programs in folders.

A program's folder has program.json, which lists its runs, metrics.csv, evaluations.csv
if policies were evaluated, checkpoints/ and, once its training has ended,
training.json. Its name is a hash of its runs, so two programs never share a folder.
"""

import contextlib
import dataclasses
import hashlib
import itertools
import json
import math
import os
import pathlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

from gasil_jax.algorithms import Algorithm
from gasil_jax.errors import InputError
from gasil_jax.host import checkpoint, json_reader, metrics_files, run_folder
from gasil_jax.host.metrics_files import Columns
from gasil_jax.sweeps.runs import Run, read_run

_PROGRAM, _TRAINING = "program.json", "training.json"
#: Stands for a folder that is not made yet; nothing is stored in it.
NOWHERE = pathlib.Path(os.devnull)


@dataclasses.dataclass(frozen=True)
class Program:
    """The runs that one compiled program trains; they differ in traced numbers alone.

    Attributes:
      runs: the runs, its members.
      path: its folder, which may not exist yet.
      labels: the columns that identify the runs in its tables, (runs,) each. They are
        "seed" and others.
    """

    runs: tuple[Run, ...]
    path: pathlib.Path = NOWHERE
    labels: Mapping[str, Sequence[int]] = dataclasses.field(default_factory=dict)

    @property
    def algorithm(self) -> Algorithm:
        """The algorithm of the first run; only its traced numbers are not shared."""
        return self.runs[0].algorithm

    @property
    def seeds(self) -> tuple[int, ...]:
        """The absolute seed number of each run."""
        return tuple(run.seed for run in self.runs)

    @property
    def hyperparameters(self) -> tuple[Mapping[str, Any], ...]:
        """The traced numbers of each run, by name."""
        return tuple(run.algorithm.hyperparameters for run in self.runs)

    def below(
        self, parent: pathlib.Path, labels: Mapping[str, Sequence[int]]
    ) -> "Program":
        """Return the program with labels, and a folder that has a hash as its name."""
        keys = " ".join(run.key for run in self.runs)
        path = parent / hashlib.sha256(keys.encode()).hexdigest()[:16]
        return dataclasses.replace(self, path=path, labels=labels)

    @contextlib.contextmanager
    def opened(self) -> Iterator[None]:
        """Create and lock the folder inside the `with` block, and list its runs.

        Raises:
          InputError: if another process trains the program, or if the folder can't be
            written.
        """
        with run_folder.lock(run_folder.create(self.path)):
            if not (self.path / _PROGRAM).exists():
                every = list(dict.fromkeys(run.experiment for run in self.runs))
                content = {
                    "experiments": list(map(json.loads, every)),
                    "runs": [[every.index(x.experiment), x.seed] for x in self.runs],
                    "labels": {name: list(x) for name, x in self.labels.items()},
                }
                metrics_files.write_json(self.path / _PROGRAM, content)
            yield

    def finish(self, measured: Mapping[str, Any]) -> None:
        """Write training.json: `driver.Outcome.measured` of training to the end."""
        content = {**self._length, **measured}
        metrics_files.write_json(self.path / _TRAINING, content)

    @property
    def _length(self) -> dict[str, int]:
        iterations = self.algorithm.config.num_iterations
        return {"iterations": iterations, "members": len(self.runs)}

    @property
    def training(self) -> dict[str, Any]:
        """What `finish` wrote; empty if the program is not trained to its end."""
        try:
            content = json_reader.read(self.path / _TRAINING, dict[str, Any])
        except (FileNotFoundError, NotADirectoryError, ValueError):
            return {}
        return content if self._length.items() <= content.items() else {}

    def tables(self) -> list[tuple[Columns, Columns]]:
        """Return the metrics and the scores of each run, (rows,); {} without scores.

        Raises:
          InputError: if a table is damaged.
        """
        metrics = self._table("metrics.csv", metrics_files.SUMMARIZED)
        if len(metrics[0]["env_steps"]) != self.algorithm.config.num_iterations:
            raise InputError(f"{self.path}/metrics.csv is damaged: it lacks iterations")
        if self.training.get("evaluation_seconds") is None:
            return [(columns, {}) for columns in metrics]
        return list(zip(metrics, self._table("evaluations.csv", ("mean",))))

    def _table(self, name: str, required: Sequence[str]) -> list[Columns]:
        """Return a table by run, after checking its columns and its last row."""
        path, config, count = self.path / name, self.algorithm.config, len(self.runs)
        record = checkpoint.newest_record(self.path / "checkpoints")
        try:
            whole = metrics_files.has_recorded_rows(path, record)
            columns = metrics_files.read_metrics(path, self.labels, required)
        except OSError as error:
            raise InputError(f"{path} is damaged: {error}") from None
        last = columns["env_steps"][0, -1]
        if not whole or last != config.num_iterations * config.batch_steps:
            raise InputError(f"{path} is damaged: it lacks iterations")
        return [{name: x[i] for name, x in columns.items()} for i in range(count)]


def of_run(described: Mapping[str, Any], algorithm: Algorithm) -> Program:
    """Return the program of a run of one setting, in the run's own folder, "out".

    The fields are those of config.json, or the options.
    """
    seeds = run_folder.seeds_of(described)
    env, settings = described["env"], described["settings"]
    runs = tuple(Run(env, algorithm, seed, settings) for seed in seeds)
    return Program(runs, described["out"] or NOWHERE, {"seed": seeds})


def group(
    runs: Iterable[Run],
    most: int | None = None,
    apart: Callable[[Run], Any] = lambda run: None,
) -> list[Program]:
    """Group runs into as few programs as possible.

    Programs have `most` runs at most, by default any number. Runs for which `apart`
    returns different values do not share one.
    """
    groups: dict[tuple[str, Any], dict[Run, None]] = {}
    for run in runs:
        groups.setdefault((run.shapes, apart(run)), {})[run] = None
    parts = []
    for members in map(tuple, groups.values()):
        count = math.ceil(len(members) / (most or len(members)))
        cuts = [len(members) * part // count for part in range(count + 1)]
        parts += [Program(members[a:b]) for a, b in itertools.pairwise(cuts)]
    return parts


def read(parent: pathlib.Path, total_steps: int | None = None) -> list[Program]:
    """Return the programs that have begun in a folder's subfolders; it may be missing.

    The length of their training, `total_steps`, may have grown since; by default it is
    the one that it began with.

    Raises:
      InputError: if a program.json is damaged.
    """
    begun = []
    for path in sorted(parent.glob(f"[!.]*/{_PROGRAM}")):
        listed = json_reader.read(path, dict[str, Any])
        with json_reader.blamed(path):
            every, labels = listed["experiments"], dict(listed["labels"])
            runs = [
                read_run(every[index], seed, total_steps)
                for index, seed in listed["runs"]
            ]
            if {len(x) for x in (labels["seed"], *labels.values())} != {len(runs)}:
                raise ValueError("its labels are not those of its runs")
        begun.append(Program(tuple(runs), path.parent, labels))
    return begun


def unfinished(
    requested: Collection[Run], stored: Sequence[Program]
) -> tuple[list[Program], list[Run]]:
    """Return the programs to continue, and the requested runs that no program holds.

    Args:
      requested: the runs that are needed.
      stored: all programs that have begun, finished or not. A program that is continued
        trains all of its runs, also those that are not requested.
    """
    asked = set(requested)
    begun = [x for x in stored if not x.training and not asked.isdisjoint(x.runs)]
    asked.difference_update(*(x.runs for x in stored))
    return begun, [run for run in requested if run in asked]
