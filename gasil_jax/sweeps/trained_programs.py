"""The programs that are trained in a sweep's folder, and the files that say so.

A program's folder holds metrics.csv, with a row for each member and iteration; once
trained, training.json; and evaluations.csv if policies were evaluated.
"""

import dataclasses
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NotRequired, TypedDict

import numpy as np

from gasil_jax.errors import InputError
from gasil_jax.host import json_reader, metrics_files, run_folder
from gasil_jax.sweeps import shards
from gasil_jax.sweeps.points import check_saved
from gasil_jax.sweeps.shards import Program

#: The columns of metrics.csv that identify the members.
LABELS = ("point", "seed")
_TRAINING = "training.json"

Member = tuple[int, int]


def write_training(folder: pathlib.Path, program: Program, **measured: Any) -> None:
    """Write training.json, which marks a program as trained to its end.

    Args:
      folder: folder of the sweep or shard.
      program: the program.
      **measured: "env_steps" (over all members), "compile_seconds", "train_seconds"
        and "evaluation_seconds" (None without evaluations), all measured in the
        process that finished the program; "device" and "device_count".
    """
    iterations = program.algorithm.config.num_iterations
    content = {"iterations": iterations, "members": len(program.members), **measured}
    content["versions"] = metrics_files.versions()
    metrics_files.write_json(program.folder(folder) / _TRAINING, content)


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


def read_training(folder: pathlib.Path, program: Program) -> dict[str, Any] | None:
    """Return what `write_training` wrote; None if the program is not yet finished.

    Args:
      folder: folder of the sweep or shard.
      program: the program, whose algorithm says where its end is.
    """
    try:
        content = json_reader.read(program.folder(folder) / _TRAINING, _Training)
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return None
    ended = content["iterations"] == program.algorithm.config.num_iterations
    return content if ended and content["members"] == len(program.members) else None


@dataclasses.dataclass(frozen=True)
class TrainedPrograms:
    """The folder of a sweep or a shard, and the programs that are trained in it.

    Attributes:
      folder: folder of the sweep or shard.
      programs: the programs, with only the members that are trained there.
    """

    folder: pathlib.Path
    programs: Sequence[Program]

    @classmethod
    def from_description(
        cls, folder: pathlib.Path, description: Mapping[str, Any]
    ) -> "TrainedPrograms":
        """Return the programs of a folder, from its config.json (`run_folder.read`).

        Raises:
          InputError: if its points can't be trained.
        """
        algorithm, points = description["algorithm"], description["points"]
        check_saved(points, algorithm, folder / "config.json")
        seeds = run_folder.seeds_of(description)
        programs = shards.programs(algorithm, points, seeds)
        if description["shard"] is not None:
            programs = shards.cut_evenly(programs, shards.parse(description["shard"]))
        return cls(folder, programs)

    def unfinished(self) -> list[Program]:
        """Return the programs that are not trained to their end."""
        return [
            program
            for program in self.programs
            if read_training(self.folder, program) is None
        ]

    def trainings(self) -> list[dict[str, Any]]:
        """Return what `read_training` reads, for each finished program."""
        read = [read_training(self.folder, program) for program in self.programs]
        return [training for training in read if training is not None]

    def members(self) -> dict[Member, dict[str, np.ndarray]]:
        """Return every metric of every member, (iterations,) each; NaN where empty.

        Raises:
          InputError: if a metrics.csv is damaged.
        """
        every: dict[Member, dict[str, np.ndarray]] = {}
        for program in self.programs:
            required, rows = (
                metrics_files.SUMMARIZED,
                program.algorithm.config.num_iterations,
            )
            every |= self._table(program, "metrics.csv", required, rows=rows)
        return every

    def evaluations(self) -> dict[Member, dict[str, np.ndarray]]:
        """Return every member's scores, (evaluations,) each; empty without evaluations.

        Raises:
          InputError: if an evaluations.csv is damaged.
        """
        every: dict[Member, dict[str, np.ndarray]] = {}
        for program, training in zip(self.programs, self.trainings(), strict=True):
            if training.get("evaluation_seconds") is not None:
                every |= self._table(program, "evaluations.csv", ("mean",))
        return every

    def _table(
        self,
        program: Program,
        name: str,
        required: Sequence[str],
        *,
        rows: int | None = None,
    ) -> dict[Member, dict[str, np.ndarray]]:
        """Return a program's complete table by member, checking columns and `rows`."""
        path, config = program.folder(self.folder) / name, program.algorithm.config
        try:
            columns = metrics_files.read_metrics(
                path, (), len(program.members), (*LABELS, *required)
            )
        except OSError as error:
            raise InputError(f"{path} is damaged: {error}") from None
        labels = np.stack([columns.pop(label) for label in LABELS], axis=-1)
        if (labels != np.array(program.members)[:, None]).any():
            raise InputError(f"{path} is damaged: its rows are not in order")
        steps = columns["env_steps"][0]
        whole = steps[-1] == config.num_iterations * config.batch_steps
        if not whole or rows not in (None, len(steps)):
            raise InputError(f"{path} is damaged: it lacks iterations")
        return {
            member: {column: x[position] for column, x in columns.items()}
            for position, member in enumerate(program.members)
        }
