"""Write and read the tables of training: metrics.csv and evaluations.csv."""

import array
import contextlib
import csv
import io
import math
import os
import pathlib
from collections.abc import Mapping, Sequence

import numpy as np

from gasil_jax.errors import InputError
from gasil_jax.host import output_file

#: The columns of a table by name.
Columns = dict[str, np.ndarray]

#: Metrics that every metrics.csv has, in this order; the agent's own metrics follow.
COLUMNS = (
    "env_steps",
    "episode_return",
    "episode_length",
    "good_return",
    "discriminator_loss",
    "policy_loss",
    "value_loss",
    "entropy",
    "approx_kl",
    "explained_variance",
)

#: The columns of metrics.csv that results need.
SUMMARIZED = ("episode_return", "episode_length", "skipped_updates", "faulty_steps")


class TableWriter:
    """Appends a row for each member and iteration to a table.

    The cell of a value that is not finite is empty. Reading the others as float32 gives
    the numbers that were written. Of an existing file it keeps `rows` rows, those that
    the checkpoint has seen which training continues from, and refuses one with less.
    """

    def __init__(
        self,
        path: pathlib.Path,
        labels: Mapping[str, Sequence[int]],
        rows: int = 0,
        *,
        columns: Sequence[str] = COLUMNS,
    ):
        self._first, self._labels, self._path = tuple(columns), labels, path
        self.rows = rows
        with output_file.errors_named(path):
            # Latin-1 takes every byte: what is no text is seen when the table is read.
            self._file = path.open("a+", newline="", encoding="latin-1")
            self._file.seek(0)
            header, size = "", 0
            for number in range(rows + 1 if rows else 0):
                line = self._file.readline()
                if not line.endswith("\n"):
                    self._file.close()
                    raise InputError(
                        f"{path} lacks rows that were in it at the last checkpoint: "
                        "restore the file, or begin a new run"
                    )
                header, size = header if number else line, size + len(line)
            self._file.truncate(size)
            self._file.seek(0, os.SEEK_END)
        self._columns = tuple(next(csv.reader([header] if header else []), ())) or None

    def write(self, metrics: Mapping[str, np.ndarray]) -> None:
        """Write arrays (members, iterations), one for each metric."""
        self._check_in_place()
        lines = io.StringIO(newline="")
        writer = csv.writer(lines)
        if self._columns is None:
            others = tuple(sorted(set(metrics) - set(self._first)))
            self._columns = (*self._labels, *self._first, *others)
            writer.writerow(self._columns)
        members, iterations = metrics["env_steps"].shape
        labels = list(zip(*self._labels.values(), strict=True))
        names = self._columns[len(self._labels) :]
        for iteration in range(iterations):
            for member in range(members):
                cells = (
                    _cell(metrics[name][member, iteration]) if name in metrics else ""
                    for name in names
                )
                writer.writerow([*labels[member], *cells])
        try:
            with output_file.errors_named(self._path):
                self._file.write(lines.getvalue())
                self._file.flush()
        except output_file.WriteError:
            # Python would write what is left once there is room, when training may
            # have continued from a checkpoint.
            with contextlib.suppress(OSError):
                self._file.close()
            raise
        self.rows += members * iterations

    def flush(self) -> None:
        """Write everything to the disk; raise `WriteError` as `write` does."""
        self._check_in_place()
        with output_file.errors_named(self._path):
            output_file.flush(self._file.fileno())

    def _check_in_place(self) -> None:
        """Raise `WriteError` if the file at the path is not the one that was opened."""
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            if os.path.samestat(self._path.stat(), os.fstat(self._file.fileno())):
                return
        raise output_file.WriteError(
            f"{self._path} was deleted or replaced during training"
        )

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _cell(value: np.ndarray) -> str:
    if not np.isfinite(value):
        return ""
    return str(int(value)) if value == int(value) else str(np.float32(value))


def read(
    path: pathlib.Path,
    labels: Mapping[str, Sequence[int]],
    required: Sequence[str] = (),
) -> Columns:
    """Return a table's columns, (members, iterations), NaN where a cell is empty."""
    num_members = len(labels["seed"])
    header: list[str] = []
    cells = array.array("d")
    try:
        with path.open(newline="") as file:
            # A table may be large: only its numbers are kept.
            for number, row in enumerate(csv.reader(x for x in file if x[-1:] == "\n")):
                header = header or row
                if len(row) != len(header):
                    raise ValueError(f"row {number} has {len(row)} cells")
                if number:
                    cells.extend(float(x) if x else math.nan for x in row)
        if not (width := num_members * len(header)):
            return {}
        # Training may be writing the last iteration.
        del cells[len(cells) // width * width :]
        values = np.array(cells).reshape(-1, num_members, len(header))
    except (ValueError, csv.Error) as error:
        raise InputError(f"{path} is damaged: {error}") from None
    columns = {name: values[:, :, i].T for i, name in enumerate(header)}
    for name in ("env_steps", *labels, *required):
        if name not in columns:
            raise InputError(f"{path} is damaged: it has no column {name}")
    steps = columns["env_steps"]
    in_order = (steps == steps[0]).all() and (np.diff(steps[0]) > 0).all()
    for label, members in labels.items():
        in_order &= (columns.pop(label) == np.array(members)[:, None]).all()
    if not in_order:
        raise InputError(f"{path} is damaged: its rows are not in order")
    return columns if values.size else {}


def final_returns(returns: np.ndarray) -> np.ndarray:
    """Return the mean returns over the last tenth of iterations, (..., iterations).

    It also works for other metrics of episodes, such as their length. If no episode of
    a seed ended in the last tenth (in some tasks all episodes end at once), the result
    is the value of the last iteration in which one ended; NaN if none ended at all.
    """
    last = returns[..., -max(1, returns.shape[-1] // 10) :]
    count = np.isfinite(last).sum(axis=-1)
    mean = np.nansum(last, axis=-1) / np.maximum(count, 1)
    ended = np.isfinite(returns)
    last_ended = returns.shape[-1] - 1 - ended[..., ::-1].argmax(axis=-1)
    newest = np.take_along_axis(returns, last_ended[..., None], axis=-1)[..., 0]
    newest = np.where(ended.any(axis=-1), newest, np.nan)
    return np.where(count > 0, mean, newest)


def finals(metrics: Columns, scores: Columns) -> dict[str, np.ndarray]:
    """Return the final values of runs by name, (...), from columns (..., rows)."""
    values = {
        f"final_{name}": final_returns(metrics[f"episode_{name}"])
        for name in ("return", "length")
    }
    return values | ({"final_evaluation": scores["mean"][..., -1]} if scores else {})
