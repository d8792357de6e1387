"""Write JSON files; write and read tables such as metrics.csv."""

import array
import contextlib
import csv
import dataclasses
import hashlib
import importlib.metadata
import io
import itertools
import json
import math
import os
import pathlib
import platform
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from gasil_jax.errors import InputError
from gasil_jax.host import json_reader, output_file

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

#: The columns of metrics.csv that summaries need.
SUMMARIZED = ("episode_return", "episode_length", "skipped_updates")


def versions() -> dict[str, str | None]:
    """Return the versions of Python and packages; None if one is not installed."""
    packages = (
        "gasil_jax",
        "jax",
        "jaxlib",
        "flax",
        "optax",
        "brax",
        "mujoco",
        "mujoco-mjx",
        "gymnasium",
        "numpy",
    )
    return {"python": platform.python_version()} | {
        name: _version(name) for name in packages
    }


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def write_json(path: pathlib.Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file atomically, with a hash by which its reader sees changes."""
    plain = json.loads(to_json(content))
    text = to_json({**plain, json_reader.HASH: json_reader.digest(plain)})
    with output_file.atomic(path) as partial:
        partial.write_text(text + "\n")


def to_json(content: Mapping[str, Any]) -> str:
    """Return what `write_json` writes.

    Raises:
      TypeError: if a value has no JSON form.
    """
    return json.dumps(content, indent=2, default=_to_json, allow_nan=False)


def _to_json(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return np.asarray(value).tolist()
    raise TypeError(f"{type(value).__name__} has no JSON form")


class MetricsWriter:
    """Appends a row for each member and iteration to a table such as metrics.csv.

    The cell of a value that is not finite (no episode ended yet, no discriminator) is
    empty. Reading the others as float32 gives the numbers that were written.

    Args:
      path: the file.
      labels: columns that identify the members, (members,) each: "seed" and others.
      checkpoint: the record of the checkpoint that training continues from; None if
        training begins. Rows of an existing file that are not in the record are moved
        to a new file beside it.
      columns: metrics to write first, in this order; others follow.

    Raises:
      ValueError: if rows that the checkpoint has seen are missing or have changed.
    """

    def __init__(
        self,
        path: pathlib.Path,
        labels: Mapping[str, Sequence[Any]],
        checkpoint: Mapping[str, Any] | None = None,
        *,
        columns: Sequence[str] = COLUMNS,
    ):
        self._first = tuple(columns)
        self._labels, self._path = labels, path
        if checkpoint is not None:
            size = checkpoint[f"{path.stem}_size"]
            whole = has_recorded_rows(path, checkpoint) and path.is_file()
            if not whole or path.stat().st_size < size:
                raise ValueError(
                    f"{path} lacks rows that were in it at the last checkpoint: "
                    "restore the file, or begin a new run"
                )
            _cut(path, size)
        elif path.exists():
            _cut(path, 0)
        self._file = path.open("a", newline="")
        # The number and the hash of all lines so far.
        self._rows, self._digest = _rows_and_digest(path)
        with path.open(newline="") as file:
            self._columns = tuple(next(csv.reader(file), ())) or None

    def write(self, metrics: Mapping[str, np.ndarray]) -> None:
        """Write arrays (members, iterations), one for each metric.

        Raises:
          output_file.WriteError: if they can't be written, or if the file is not at its
            path any more.
        """
        self._check_in_place()
        lines = self._lines(metrics)
        with self._errors_named():
            self._file.write(lines)
            self._file.flush()
        self._rows += lines.count("\n")
        self._digest.update(lines.replace("\r\n", "\n").encode(self._file.encoding))

    def _lines(self, metrics: Mapping[str, np.ndarray]) -> str:
        """Return the rows of metrics, and before the first ones the names."""
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
        return lines.getvalue()

    def record(self) -> dict[str, Any]:
        """Write everything to the disk; return what a checkpoint records of the file.

        That is its size in bytes, its number of lines and their hash.

        Raises:
          output_file.WriteError: as `write` does.
        """
        self._check_in_place()
        with self._errors_named():
            self._file.flush()
            output_file.flush(self._file.fileno())
            size, name = os.fstat(self._file.fileno()).st_size, self._path.stem
        return {
            f"{name}_size": size,
            f"{name}_rows": self._rows,
            f"{name}_sha256": self._digest.hexdigest(),
        }

    @contextlib.contextmanager
    def _errors_named(self) -> Iterator[None]:
        try:
            with output_file.errors_named(self._path):
                yield
        except output_file.WriteError:
            # Python would write what is left once there is room, when training may
            # have continued from a checkpoint.
            with contextlib.suppress(OSError):
                self._file.close()
            raise

    def _check_in_place(self) -> None:
        """Raise `WriteError` if the file at the path is not the one that was opened."""
        try:
            there = self._path.stat()
            in_place = os.path.samestat(there, os.fstat(self._file.fileno()))
        except (FileNotFoundError, NotADirectoryError):
            in_place = False
        if not in_place:
            raise output_file.WriteError(
                f"{self._path} was deleted or replaced during training"
            )

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _rows_and_digest(path: pathlib.Path, most: int | None = None) -> tuple[int, Any]:
    """Return the number of whole lines, or `most`, and their SHA-256.

    The hash does not see how lines end, because version control may change it.
    """
    digest, count = hashlib.sha256(), 0
    with path.open("rb") as file:
        for line in itertools.islice(file, most):
            if line.endswith(b"\n"):
                digest.update(line.rstrip(b"\r\n") + b"\n")
                count += 1
    return count, digest


def has_recorded_rows(path: pathlib.Path, record: Mapping[str, Any]) -> bool:
    """Return whether a table has all rows that a checkpoint has seen of it.

    Args:
      path: the table, which may be missing.
      record: the checkpoint's record. An older version recorded no rows.

    Raises:
      InputError: if one of these rows has changed.
    """
    rows, seen = (record.get(f"{path.stem}_{x}") for x in ("rows", "sha256"))
    if not rows:
        return True
    if not path.is_file():
        return False
    count, digest = _rows_and_digest(path, rows)
    if count == rows and digest.hexdigest() != seen:
        raise InputError(f"{path} is damaged: it has changed since the checkpoint")
    return count == rows


def _cut(path: pathlib.Path, size: int) -> None:
    """Shorten a file to `size` bytes, and move the rest to a new file beside it."""
    with path.open("rb+") as file:
        file.seek(max(0, size - 1))
        if size and file.read(1) != b"\n":
            raise ValueError(f"{path} is damaged: it has changed since the checkpoint")
        rest = file.read()
        if not rest:
            return
        number = 1
        while True:
            beside = path.with_name(f"{path.stem}-cut-{number}{path.suffix}")
            try:
                with beside.open("xb") as other:
                    other.write(rest)
                break
            except FileExistsError:
                number += 1
        file.truncate(size)


def _cell(value: Any) -> str:
    if not np.isfinite(value):
        return ""
    return str(int(value)) if value == int(value) else str(np.float32(value))


def read_metrics(
    path: pathlib.Path,
    labels: Mapping[str, Sequence[int]],
    required: Sequence[str] = (),
    *,
    unfinished: bool = False,
) -> Columns:
    """Return every metric of a `MetricsWriter`'s file, (members, iterations) each.

    Args:
      path: the file; an empty cell becomes NaN.
      labels: columns that identify the members, (members,) each: "seed" and others.
      required: columns that it must have besides "env_steps".
      unfinished: leave out a last iteration that is incomplete, because training may be
        writing it. The result is empty if no iteration is complete yet.

    Raises:
      InputError: if the file is damaged, has no rows or lacks a column.
      OSError: if there is no such file.
    """
    num_members = len(labels["seed"])
    try:
        with path.open(newline="") as file:
            header: list[str] = []
            cells = array.array("d")
            # A table may be large: only its numbers are kept.
            lines = (x for x in file if not unfinished or x.endswith("\n"))
            for number, row in enumerate(csv.reader(lines)):
                header = header or row
                if len(row) != len(header):
                    raise ValueError(f"row {number} has {len(row)} cells")
                if number:
                    cells.extend(float(x) if x else math.nan for x in row)
        width = num_members * len(header)
        if unfinished and width > 0:
            del cells[len(cells) // width * width :]
        if unfinished and not cells:
            return {}
        if not cells:
            raise ValueError("it has no rows")
        values = np.array(cells).reshape(-1, num_members, len(header))
    except (ValueError, csv.Error) as error:
        raise InputError(f"{path} is damaged: {error}") from None
    metrics = {name: values[:, :, i].T for i, name in enumerate(header)}
    for name in ("env_steps", *labels, *required):
        if name not in metrics:
            raise InputError(f"{path} is damaged: it has no column {name}")
    steps = metrics["env_steps"]
    if not (steps == steps[0]).all() or not (np.diff(steps[0]) > 0).all():
        raise InputError(f"{path} is damaged: its env_steps are not in order")
    for label, members in labels.items():
        if (metrics.pop(label) != np.array(members)[:, None]).any():
            raise InputError(f"{path} is damaged: its rows are not in order")
    return metrics


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
    """Return the final values of runs by name, (...), from columns (..., rows).

    They are those of metrics.csv and, if there are any, of evaluations.csv.
    """
    values = {
        f"final_{name}": final_returns(metrics[f"episode_{name}"])
        for name in ("return", "length")
    }
    return values | ({"final_evaluation": scores["mean"][..., -1]} if scores else {})
