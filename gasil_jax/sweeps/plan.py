"""The plan of a sweep: every point with every seed is a run."""

import dataclasses
import functools
import pathlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from gasil_jax.algorithms import Algorithm
from gasil_jax.host import run_folder
from gasil_jax.host.environments import Settings
from gasil_jax.sweeps import programs
from gasil_jax.sweeps.points import Point, check_saved
from gasil_jax.sweeps.programs import Program, ProgramFolder
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
        return {
            (index, seed): Run(self.env, changed, seed, self.settings)
            for index, changed in enumerate(
                self.algorithm.replace(**point) for point in self.points
            )
            for seed in self.seeds
        }

    @functools.cached_property
    def _members(self) -> Mapping[Run, tuple[int, int]]:
        # Two points may be the same run, which the first of them names.
        return {run: member for member, run in reversed(list(self.runs.items()))}

    def labels(self, program: Program) -> dict[str, Sequence[int]]:
        """Return the columns that identify a program's runs in its tables."""
        members = [self._members[run] for run in program.runs]
        return dict(zip(LABELS, zip(*members, strict=True), strict=True))

    @property
    def total_steps(self) -> int:
        """The environment steps of each run."""
        return self.algorithm.config.total_steps

    def stored(self, folder: pathlib.Path) -> list[ProgramFolder]:
        """Return the programs that have begun in the sweep's folder."""
        return programs.read(programs_of(folder), self.total_steps)

    def trained(self, folder: pathlib.Path) -> list[ProgramFolder]:
        """Return the programs that are trained to their end, of runs of this plan."""
        own = set(self.runs.values())
        return [
            each
            for each in self.stored(folder)
            if each.training and not own.isdisjoint(each.program.runs)
        ]

    def missing(self, trained: Iterable[ProgramFolder]) -> list[tuple[int, int]]:
        """Return the (index of the point, seed) of each run that no program has."""
        done = {run for each in trained for run in each.program.runs}
        return [member for member, run in self.runs.items() if run not in done]

    def unfinished(
        self, folder: pathlib.Path, requested: Collection[Run]
    ) -> list[ProgramFolder]:
        """Return the programs that are still to be trained for the requested runs."""
        return programs.unfinished(
            requested,
            programs_of(folder),
            labels=self.labels,
            total_steps=self.total_steps,
        )


def programs_of(folder: pathlib.Path) -> pathlib.Path:
    """Return the folder of a sweep's programs."""
    return folder / "programs"


def stored_plan(folder: pathlib.Path, description: Mapping[str, Any]) -> Plan:
    """Return the plan of a stored sweep, from its config.json (`run_folder.read`).

    Raises:
      InputError: if its points can't be trained.
    """
    algorithm, points = description["algorithm"], description["points"]
    check_saved(points, algorithm, folder / run_folder.CONFIG)
    return Plan(
        description["env"],
        description["settings"],
        algorithm,
        points,
        run_folder.seeds_of(description),
    )
