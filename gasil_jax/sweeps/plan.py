"""The plan of a sweep: every point with every seed is a run."""

import dataclasses
import functools
import pathlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from gasil_jax.algorithms import Algorithm
from gasil_jax.errors import InputError
from gasil_jax.host import json_reader, run_folder
from gasil_jax.host.environments import Settings
from gasil_jax.sweeps import points, programs
from gasil_jax.sweeps.points import Point
from gasil_jax.sweeps.programs import Program
from gasil_jax.sweeps.runs import Run

#: The columns of a sweep's tables that identify its members.
LABELS = ("point", "seed")


@dataclasses.dataclass(frozen=True)
class Plan:
    """The points and seeds of a sweep.

    Attributes:
      env: name of the environment.
      settings: settings of the environment.
      algorithm: the algorithm that the points change.
      points: changed settings, by name. A point that is added later comes last.
      seeds: absolute seed numbers.
    """

    env: str
    settings: Settings
    algorithm: Algorithm
    points: Sequence[Point]
    seeds: Sequence[int]

    @functools.cached_property
    def runs(self) -> Mapping[tuple[int, int], Run]:
        """The run of each (index of the point, seed)."""
        every = [self.algorithm.replace(**point) for point in self.points]
        return {
            (index, seed): Run(self.env, changed, seed, self.settings)
            for index, changed in enumerate(every)
            for seed in self.seeds
        }

    def part(self, number: int = 1, count: int = 1) -> list[Run]:
        """Return the runs of shard `number`, counted from 1, of `count` shards.

        They do not depend on which runs are trained already. The sizes of shards differ
        by one run at most, and the runs of a program are divided as little as possible.

        Raises:
          InputError: if there are more shards than runs.
        """
        ordered = [x for each in programs.group(self.runs.values()) for x in each.runs]
        total = len(ordered)
        if count > total:
            raise InputError(
                f"shard is {number}/{count}: {total} members (points x seeds) make "
                f"{total} shards at most"
            )
        return ordered[(number - 1) * total // count : number * total // count]

    @functools.cached_property
    def _members(self) -> Mapping[Run, tuple[int, int]]:
        # Two points may be the same run, which the first of them names.
        return {run: member for member, run in reversed(list(self.runs.items()))}

    def labels(self, program: Program) -> dict[str, Sequence[int]]:
        """Return the columns that identify a program's runs in its tables."""
        members = [self._members[run] for run in program.runs]
        return dict(zip(LABELS, zip(*members, strict=True), strict=True))

    def stored(self, folder: pathlib.Path) -> list[Program]:
        """Return the programs that have begun in the folder of the sweep."""
        return programs.read(programs_of(folder), self.algorithm.config.total_steps)

    def trained(self, folder: pathlib.Path) -> list[Program]:
        """Return the programs that are trained to their end, of runs of this plan."""
        own = set(self.runs.values())
        stored = [x for x in self.stored(folder) if not own.isdisjoint(x.runs)]
        return [x for x in stored if x.training]

    def missing(self, trained: Iterable[Program]) -> list[tuple[int, int]]:
        """Return the (index of the point, seed) of each run that no program has."""
        done = {run for each in trained for run in each.runs}
        return [member for member, run in self.runs.items() if run not in done]

    def unfinished(
        self, folder: pathlib.Path, requested: Collection[Run]
    ) -> list[Program]:
        """Return the programs that are still to be trained for the requested runs."""
        begun, others = programs.unfinished(requested, self.stored(folder))
        parent = programs_of(folder)
        new = [x.below(parent, self.labels(x)) for x in programs.group(others)]
        return [*begun, *new]


def programs_of(folder: pathlib.Path) -> pathlib.Path:
    """Return the folder of a sweep's programs."""
    return folder / "programs"


def stored_plan(description: Mapping[str, Any]) -> Plan:
    """Return the plan of a stored sweep from its `run_folder.read`.

    Raises:
      InputError: if its points can't be trained.
    """
    with json_reader.blamed(description["out"] / run_folder.CONFIG):
        points.check(description["points"], description["algorithm"], "points: ")
    return Plan(
        description["env"],
        description["settings"],
        description["algorithm"],
        description["points"],
        run_folder.seeds_of(description),
    )
