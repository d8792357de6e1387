"""Group runs into programs, each compiled once, and keep programs in folders.

A program's folder has program.json, which lists its runs, metrics.csv, evaluations.csv
if policies were evaluated, checkpoints/ and, once its training has ended,
training.json. Its name is a hash of its runs, so two programs never share a folder.
"""

import contextlib
import dataclasses
import functools
import hashlib
import itertools
import json
import math
import pathlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, NotRequired, TypedDict

import numpy as np

from gasil_jax.algorithms import Algorithm
from gasil_jax.errors import InputError, NotImportable
from gasil_jax.host import checkpoint, json_reader, metrics_files, run_folder
from gasil_jax.sweeps.runs import Run, read_run

_PROGRAM, _TRAINING = "program.json", "training.json"


@dataclasses.dataclass(frozen=True)
class Program:
    """The runs that one compiled program trains; they differ in traced numbers alone.

    Attributes:
      runs: the runs, its members.
    """

    runs: tuple[Run, ...]

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

    @property
    def env_steps(self) -> int:
        """The number of environment steps over all runs."""
        config = self.algorithm.config
        return config.num_iterations * config.batch_steps * len(self.runs)

    @functools.cached_property
    def name(self) -> str:
        """A hash of its runs, the name of its folder."""
        keys = " ".join(run.key for run in self.runs)
        return hashlib.sha256(keys.encode()).hexdigest()[:16]


def group(
    runs: Iterable[Run],
    most: int | None = None,
    apart: Callable[[Run], Any] = lambda run: None,
) -> list[Program]:
    """Group runs into as few programs as possible.

    Args:
      runs: the runs.
      most: the largest number of runs in a program; default no limit.
      apart: runs for which it returns different values do not share a program.
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


class _Training(TypedDict):
    """The content of training.json."""

    iterations: int
    members: int
    env_steps: int
    compile_seconds: float
    train_seconds: float
    evaluation_seconds: NotRequired[float | None]
    device: str
    device_count: int
    versions: dict[str, str | None]


class _Listed(TypedDict):
    """The content of program.json: the runs as (index of the experiment, seed)."""

    experiments: tuple[Any, ...]
    runs: tuple[tuple[int, int], ...]
    labels: dict[str, tuple[int, ...]]


@dataclasses.dataclass(frozen=True)
class ProgramFolder:
    """A program and its folder, which may not exist yet.

    Attributes:
      program: the program.
      path: the folder.
      labels: the columns that identify the runs in its tables, (runs,) each. They are
        "seed" and others.
    """

    program: Program
    path: pathlib.Path
    labels: Mapping[str, Sequence[int]]

    @contextlib.contextmanager
    def opened(self) -> Iterator[None]:
        """Create and lock the folder inside the `with` block, and list its runs.

        Raises:
          InputError: if another process trains the program, or if the folder can't be
            written.
        """
        with run_folder.lock(run_folder.create(self.path)):
            if not (self.path / _PROGRAM).exists():
                runs = self.program.runs
                every = list(dict.fromkeys(run.experiment for run in runs))
                listed = [[every.index(run.experiment), run.seed] for run in runs]
                content = {
                    "experiments": list(map(json.loads, every)),
                    "runs": listed,
                    "labels": {name: list(x) for name, x in self.labels.items()},
                }
                metrics_files.write_json(self.path / _PROGRAM, content)
            yield

    def finish(self, **measured: Any) -> None:
        """Write training.json, which says that the program is trained to its end.

        Args:
          **measured: "env_steps" (over all members), "compile_seconds", "train_seconds"
            and "evaluation_seconds" (None without evaluations), all measured in the
            process that finished the program; "device" and "device_count".
        """
        content = {
            "iterations": self.program.algorithm.config.num_iterations,
            "members": len(self.program.runs),
            **measured,
            "versions": metrics_files.versions(),
        }
        metrics_files.write_json(self.path / _TRAINING, content)

    @property
    def training(self) -> dict[str, Any]:
        """What `finish` wrote; empty if the program is not trained to its end."""
        try:
            content = json_reader.read(self.path / _TRAINING, _Training)
        except (FileNotFoundError, NotADirectoryError, ValueError):
            return {}
        ended = content["iterations"] == self.program.algorithm.config.num_iterations
        same = content["members"] == len(self.program.runs)
        return content if ended and same else {}

    def tables(self) -> tuple[list[dict[str, np.ndarray]], list[dict[str, np.ndarray]]]:
        """Return the metrics and the scores of each run, (rows,) each column.

        The scores are none without evaluations.

        Raises:
          InputError: if a table is damaged.
        """
        config = self.program.algorithm.config
        required, rows = metrics_files.SUMMARIZED, config.num_iterations
        metrics = self._table("metrics.csv", required, rows)
        if self.training.get("evaluation_seconds") is None:
            return metrics, []
        return metrics, self._table("evaluations.csv", ("mean",))

    def _table(
        self, name: str, required: Sequence[str], rows: int | None = None
    ) -> list[dict[str, np.ndarray]]:
        """Return a complete table by run, after checking its columns and `rows`."""
        path, config = self.path / name, self.program.algorithm.config
        record = checkpoint.newest_record(self.path / "checkpoints")
        try:
            whole = metrics_files.has_recorded_rows(path, record)
            columns = metrics_files.read_metrics(
                path, (), len(self.program.runs), (*self.labels, *required)
            )
        except OSError as error:
            raise InputError(f"{path} is damaged: {error}") from None
        for label, values in self.labels.items():
            if (columns.pop(label) != np.array(values)[:, None]).any():
                raise InputError(f"{path} is damaged: its rows are not in order")
        steps = columns["env_steps"][0]
        whole &= steps[-1] == config.num_iterations * config.batch_steps
        if not whole or rows not in (None, len(steps)):
            raise InputError(f"{path} is damaged: it lacks iterations")
        return [
            {column: x[position] for column, x in columns.items()}
            for position in range(len(self.program.runs))
        ]


def read(parent: pathlib.Path, total_steps: int | None = None) -> list[ProgramFolder]:
    """Return the programs that have begun in the folders of a folder.

    Args:
      parent: the folder, which may be missing.
      total_steps: the length of the training, which may have grown since it began;
        default the one that it began with.

    Raises:
      InputError: if a program.json is damaged.
    """
    paths = sorted(parent.glob(f"[!.]*/{_PROGRAM}"))
    return [_read(path, total_steps) for path in paths]


def _read(path: pathlib.Path, total_steps: int | None) -> ProgramFolder:
    listed = json_reader.read(path, _Listed)
    try:
        experiments = listed["experiments"]
        every = [read_run(experiments[index], seed) for index, seed in listed["runs"]]
        if total_steps is not None:
            every = [run.with_total_steps(total_steps) for run in every]
    except NotImportable:
        raise
    except (ValueError, KeyError, IndexError, TypeError) as error:
        raise InputError(f"{path} is damaged: {error}") from None
    return ProgramFolder(Program(tuple(every)), path.parent, listed["labels"])


def unfinished(
    requested: Collection[Run],
    parent: pathlib.Path,
    *,
    labels: Callable[[Program], Mapping[str, Sequence[int]]],
    total_steps: int | None = None,
    most: int | None = None,
    apart: Callable[[Run], Any] = lambda run: None,
) -> list[ProgramFolder]:
    """Return the programs that are still to be trained, those that have begun first.

    A program that has begun trains all of its runs, also those that are not requested.

    Args:
      requested: the runs.
      parent: the folder with the folders of programs.
      labels: returns the labels of a new program, see `ProgramFolder`.
      total_steps: see `read`.
      most: see `group`.
      apart: see `group`.

    Raises:
      InputError: if a program.json is damaged.
    """
    stored = read(parent, total_steps)
    in_training = [each for each in stored if not each.training]
    begun_or_trained = {run for each in stored for run in each.program.runs}
    others = (run for run in requested if run not in begun_or_trained)
    new = group(others, most, apart)
    asked = set(requested)
    return [
        *(each for each in in_training if not asked.isdisjoint(each.program.runs)),
        *(ProgramFolder(x, parent / x.name, labels(x)) for x in new),
    ]
