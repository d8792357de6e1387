"""Programs: runs that share shapes, trained as one vmapped batch, and their folders.

A program's folder has program.json, which lists its runs, metrics.csv, evaluations.csv
if policies are evaluated, checkpoints/ and, once its training has ended, training.json.
The folder's name is a hash of the runs, so two programs never share one.
"""

import contextlib
import dataclasses
import functools
import hashlib
import itertools
import json
import math
import os
import pathlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, TypedDict

from gasil_jax.algorithms import Algorithm
from gasil_jax.errors import InputError
from gasil_jax.host import folders, json_files, tables
from gasil_jax.host.output_file import note
from gasil_jax.host.runs import Run, identity
from gasil_jax.host.tables import Columns

_PROGRAM, _TRAINING = "program.json", "training.json"
#: Stands for a folder that is not made yet; nothing is stored in it.
NOWHERE = pathlib.Path(os.devnull)


class Training(TypedDict):
    """How a program was trained, the content of training.json."""

    iterations: int
    env_steps: int  # environment steps over all members in the last process
    compile_seconds: float
    train_seconds: float  # seconds of training, without evaluations and films
    evaluation_seconds: float | None  # seconds of evaluations; None without any
    device: str
    device_count: int
    versions: dict[str, str | None]


class _Listed(TypedDict):
    """The content of program.json."""

    experiments: tuple[dict[str, Any], ...]  # `Run.experiment` of the runs, each once
    # The index of its experiment and the seed of each run.
    runs: tuple[tuple[int, int], ...]
    labels: dict[str, tuple[int, ...]]  # `Program.labels`


@dataclasses.dataclass(frozen=True)
class Program:
    """Runs that differ in traced numbers alone, trained as one batch."""

    runs: tuple[Run, ...]  # the members
    path: pathlib.Path = NOWHERE  # its folder, which may not exist yet
    # The columns that identify the members in its tables, (members,) each: "seed" and
    # others. Its folder may hold further members, of runs that nobody has asked for.
    labels: Mapping[str, Sequence[int]] = dataclasses.field(default_factory=dict)
    indices: tuple[int, ...] = ()  # the place of each run among all members

    @property
    def algorithm(self) -> Algorithm:
        """The algorithm of the first run; only its traced numbers are not shared."""
        return self.runs[0].algorithm

    @property
    def seeds(self) -> tuple[int, ...]:
        """The seed of each run."""
        return tuple(run.seed for run in self.runs)

    @property
    def hyperparameters(self) -> tuple[Mapping[str, Any], ...]:
        """The traced numbers of each run, by name."""
        return tuple(run.algorithm.hyperparameters for run in self.runs)

    @property
    def num_members(self) -> int:
        """The number of members, also of runs that nobody has asked for."""
        return len(self.labels["seed"])

    def below(
        self, parent: pathlib.Path, labels: Mapping[str, Sequence[int]]
    ) -> "Program":
        """Return the program with labels, and a folder that has a hash as its name."""
        keys = " ".join(run.key for run in self.runs)
        path = parent / hashlib.sha256(keys.encode()).hexdigest()[:16]
        every = tuple(range(len(self.runs)))
        return dataclasses.replace(self, path=path, labels=labels, indices=every)

    def only(self, kept: Sequence[int]) -> "Program":
        """Return the program with some of its runs, by their places in `runs`."""
        return dataclasses.replace(
            self,
            runs=tuple(self.runs[i] for i in kept),
            indices=tuple(self.indices[i] for i in kept),
        )

    @contextlib.contextmanager
    def opened(self) -> Iterator[None]:
        """Create and lock the folder inside the `with` block, and list its runs."""
        with folders.lock(folders.create(self.path)):
            if not (self.path / _PROGRAM).exists():
                every = list(dict.fromkeys(run.experiment for run in self.runs))
                content = {
                    "experiments": list(map(json.loads, every)),
                    "runs": [[every.index(x.experiment), x.seed] for x in self.runs],
                    "labels": {name: list(x) for name, x in self.labels.items()},
                }
                json_files.write(self.path / _PROGRAM, content)
            yield

    def finish(self, training: Training) -> None:
        """Write training.json."""
        json_files.write(self.path / _TRAINING, training)

    @property
    def training(self) -> Training | None:
        """What `finish` wrote; None if training has not ended."""
        try:
            return json_files.read(self.path / _TRAINING, Training)
        except (FileNotFoundError, NotADirectoryError):
            return None

    @property
    def is_finished(self) -> bool:
        """Whether all iterations are trained."""
        training, needed = self.training, self.algorithm.config.num_iterations
        return training is not None and training["iterations"] >= needed

    def tables(self) -> list[tuple[Columns, Columns]]:
        """Return the metrics and the scores of each trained run; {} without scores."""
        training = self.training
        assert training is not None
        metrics = self.table("metrics.csv", tables.SUMMARIZED)
        if len(metrics[0].get("env_steps", ())) < training["iterations"]:
            raise InputError(f"{self.path}/metrics.csv is damaged: it lacks iterations")
        if training["evaluation_seconds"] is None:
            return [(columns, {}) for columns in metrics]
        scores = self.table("evaluations.csv", ("mean",))
        last = metrics[0]["env_steps"][-1]
        # Training that was stopped has no evaluation at its end.
        if self.is_finished and not (scores[0] and scores[0]["env_steps"][-1] >= last):
            raise InputError(f"{self.path}/evaluations.csv is damaged: it lacks rows")
        return list(zip(metrics, scores))

    def table(self, name: str, required: Sequence[str]) -> list[Columns]:
        """Return a table's columns, (rows,), by run; {} if it has no rows yet."""
        path = self.path / name
        try:
            columns = tables.read(path, self.labels, required)
        except FileNotFoundError:
            training = self.training
            if training and (name == "metrics.csv" or training["evaluation_seconds"]):
                raise InputError(f"{path} is damaged: it is missing") from None
            columns = {}
        return [{name: x[i] for name, x in columns.items()} for i in self.indices]


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


def read(parent: pathlib.Path, requested: Collection[Run]) -> list[Program]:
    """Return the programs in a folder's subfolders that hold some requested runs.

    The length of a run's training is that of the requested one, which may have grown.
    """
    known, stored = {run.identity: run for run in requested}, []
    for path in sorted(parent.glob(f"[!.]*/{_PROGRAM}")):
        listed: _Listed = json_files.read(path, _Listed)
        with json_files.blamed(path):
            every, labels = listed["experiments"], listed["labels"]
            members = [identity(every[i], seed) for i, seed in listed["runs"]]
            seeds = tuple(seed for _, seed in listed["runs"])
            if labels["seed"] != seeds or {len(x) for x in labels.values()} != {
                len(members)
            }:
                raise ValueError("its labels are not those of its runs")
        indices = tuple(i for i, x in enumerate(members) if x in known)
        if indices:
            runs = tuple(known[members[i]] for i in indices)
            program = Program(runs, path.parent, labels, indices)
            config, training = program.algorithm.config, program.training
            # It was copied here, and what learned for longer is another run.
            if every[0]["algorithm"]["total_steps"] > config.total_steps:
                continue
            if training and training["iterations"] > config.num_iterations:
                steps = training["iterations"] * config.batch_steps
                raise InputError(
                    f"{path.parent} was continued to {steps:,} steps: total_steps must "
                    "be that, or the folder be moved away"
                )
            stored.append(program)
    return stored


def labelled(parent: pathlib.Path, point: int) -> list[Program]:
    """Return the programs of a point without its runs: their tables can be read."""
    every = []
    for path in sorted(parent.glob(f"[!.]*/{_PROGRAM}")):
        labels = json_files.read(path, _Listed)["labels"]
        with json_files.blamed(path):
            indices = tuple(i for i, x in enumerate(labels["point"]) if x == point)
            if indices:
                every.append(Program((), path.parent, labels, indices))
    return every


@functools.cache
def _note_left(path: pathlib.Path) -> None:
    note(
        f"{path} has begun with further runs, which are not asked for: it is not "
        "continued, and the others are trained anew"
    )


def unfinished(
    requested: Collection[Run], stored: Sequence[Program]
) -> tuple[list[Program], list[Run]]:
    """Return the programs to continue, and the requested runs that no program holds."""
    finished = [x for x in stored if x.is_finished]
    # A program that is continued trains all of its runs, also those of others.
    whole = [x for x in stored if len(x.runs) == x.num_members]
    begun = [x for x in whole if x not in finished]
    for each in stored:
        if each not in (*finished, *begun):
            _note_left(each.path)
    held = {run for x in (*finished, *begun) for run in x.runs}
    return begun, [run for run in requested if run not in held]
