"""The files of a run folder: config.json, metrics.csv, summary.json."""

import csv
import dataclasses
import importlib.metadata
import json
import pathlib
import platform
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

#: Columns of metrics.csv that every run has, in this order; an agent's own follow.
COLUMNS = (
    "seed",
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


def versions() -> dict[str, str | None]:
    """Versions of what a result depends on; None for what isn't installed."""
    packages = ("gasil_jax", "jax", "jaxlib", "flax", "optax", "brax")
    packages += ("mujoco", "mujoco-mjx", "gymnasium", "numpy")
    return {"python": platform.python_version()} | {
        name: _version(name) for name in packages
    }


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def write_json(path: pathlib.Path, content: Mapping[str, Any]) -> None:
    """Write atomically, so that a reader never sees half a file."""
    temporary = path.with_name(path.name + ".partial")
    text = json.dumps(content, indent=2, default=_to_json, allow_nan=False)
    temporary.write_text(text + "\n")
    temporary.replace(path)


def _to_json(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return dataclasses.asdict(value)
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return np.asarray(value).tolist()
    raise TypeError(f"{type(value).__name__} has no JSON form")


class MetricsWriter:
    """Appends a row for each seed and iteration to metrics.csv.

    A value that is not finite (no episode ended yet, no discriminator) is left empty.
    """

    def __init__(self, path: pathlib.Path, seeds: Sequence[int]):
        self._file = path.open("x", newline="")
        self._writer = csv.writer(self._file)
        self._seeds = seeds
        self._columns: tuple[str, ...] | None = None

    def write(self, metrics: Mapping[str, np.ndarray]) -> None:
        """Write (seeds, iterations) arrays, one for each metric."""
        if self._columns is None:
            own = tuple(sorted(set(metrics) - set(COLUMNS)))
            self._columns = COLUMNS + own
            self._writer.writerow(self._columns)
        iterations = metrics["env_steps"].shape[1]
        for iteration in range(iterations):
            for index, seed in enumerate(self._seeds):
                row = [seed]
                for name in self._columns[1:]:
                    value = metrics[name][index, iteration] if name in metrics else None
                    row.append(_cell(value))
                self._writer.writerow(row)
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _cell(value: float | None) -> str:
    if value is None or not np.isfinite(value):
        return ""
    return str(int(value)) if value == int(value) else f"{value:.7g}"
