"""The store of runs: each run is stored once, by the settings that decide its numbers.

Each task has one file, TASK.npz, with plain arrays and one JSON text. Figures, tables
and searches ask the store for runs. A run does not record for which figure it was
trained.
"""

import dataclasses
import functools
import json
import pathlib
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from experiments.agents import OWN
from gasil_jax import npz
from gasil_jax.errors import InputError
from gasil_jax.host import descriptions, folders, json_files, output_file
from gasil_jax.host.environments import Settings
from gasil_jax.host.runs import Run

_NONE = np.empty(0)
#: The names of agents and of settings in files, where they differ from the package's.
#: So a rename needs no migration, and stored runs stay as they are.
_STORED = {agent.name: name for name, agent in OWN.items()}
_STORED |= {"initial_std": "initial_deviation"}
_CURRENT = {stored: name for name, stored in _STORED.items()}
#: Settings that are newer than stored runs, with what those had, which is the default.
#: With this value they are left out of a file.
NEWER: Mapping[str, Any] = {
    "max_episode_steps": None,
    "observe_phase": False,
    "action_noise": 0.0,
    "policy_components": 1,
    "rewards": [],
}
#: Settings that are no more: those beside which a run had one, and what all had.
_REMOVED: Mapping[str, tuple[tuple[str, ...], Any]] = {
    "value_coefficient": (("learning_rate",), 1.0),
    "admission": (("buffer_steps",), "all"),
    "ties": (("buffer_steps",), "oldest"),
    "sample_by_return": (("buffer_steps",), False),
    "buffer_discounts": (("buffer_steps",), True),
    "novelty_ties": (("buffer_steps", "novelty_cell"), "novel"),
    "discriminator_gradient_penalty": (("bonus",), 0.0),
    "discriminator_normalizes_actions": (("bonus",), False),
}
RESULTS = pathlib.Path(__file__).parent / "results"


@dataclasses.dataclass(frozen=True)
class Record:
    """The stored results of a run: means over equal parts of training, (rows,) each.

    Attributes:
      env_steps: environment steps at the end of each part.
      episode_return: mean, over the part's iterations, of the mean return of the
        episodes that ended in the iteration; NaN if none did in any.
      episode_length: the same of their lengths; NaN if it was not recorded.
      provenance: physics, device, versions, the commit of the code, and whether the
        checkout was clean.
      evaluation_steps: environment steps before each evaluation, (evaluations,).
      evaluation_return: mean return of the policy's mean action in the evaluation.
    """

    env_steps: np.ndarray
    episode_return: np.ndarray
    episode_length: np.ndarray
    provenance: Mapping[str, Any]
    evaluation_steps: np.ndarray = dataclasses.field(default_factory=lambda: _NONE)
    evaluation_return: np.ndarray = dataclasses.field(default_factory=lambda: _NONE)

    def part(self, begin: float, end: float) -> float:
        """Return the mean return between two fractions of training.

        The mean is over the rows whose middle lies between them, because a row may end
        just after a round fraction. If there is no such row, it is the row at the
        middle of the two fractions.
        """
        ends = self.env_steps / self.env_steps[-1]
        middle = (np.concatenate([[0.0], ends[:-1]]) + ends) / 2
        chosen = (middle > begin) & (middle <= end)
        if not chosen.any():
            chosen[np.searchsorted(ends, (begin + end) / 2)] = True
        rows = self.episode_return[chosen]
        rows = rows[np.isfinite(rows)]
        return float(rows.mean()) if len(rows) else float("nan")

    @property
    def first(self) -> float:
        """The first mean return of training; NaN if no episode ever ended."""
        ended = self.episode_return[np.isfinite(self.episode_return)]
        return float(ended[0]) if len(ended) else float("nan")

    @property
    def final(self) -> float:
        """The mean return over the last tenth of training.

        If no episode ended in that time, which is possible without staggered episodes,
        it is the return of the last part in which one ended; NaN if none ever did.
        """
        ended = self.episode_return[np.isfinite(self.episode_return)]
        last = self.part(0.9, 1.0)
        return float(ended[-1]) if np.isnan(last) and len(ended) else last


#: Fields of a record, by the name of the array that stores their lengths.
_TABLES = {
    "rows": ("env_steps", "episode_return", "episode_length"),
    "evaluations": ("evaluation_steps", "evaluation_return"),
}


def _rounded(name: str, values: np.ndarray) -> np.ndarray:
    """Round to six significant digits, which float32 can hold."""
    if name.endswith("_steps"):
        return values.astype(np.uint32)
    return np.array([float(f"{value:.6g}") for value in values], np.float32)


def to_stored(experiment: str) -> dict[str, Any]:
    """Return a `Run.experiment` as it stands in a file."""

    def old(fields: Mapping[str, Any]) -> dict[str, Any]:
        kept = {x: y for x, y in fields.items() if x not in NEWER or y != NEWER[x]}
        return {_STORED.get(x, x): y for x, y in kept.items()}

    fields = json.loads(experiment)
    settings = fields["algorithm"]
    agent = _STORED.get(settings["agent"], settings["agent"])
    algorithm = {**old(settings), **_removed(settings), "agent": agent}
    return {**old(fields), "algorithm": algorithm}


def from_stored(fields: Mapping[str, Any], seed: int = 0) -> Run:
    """Return the run of an experiment in a file."""
    others = dict(fields)
    own = {name: others.pop(name) for name in ("env", "algorithm_version")}
    settings = {_CURRENT.get(x, x): y for x, y in others.pop("algorithm").items()}
    settings["agent"] = _CURRENT.get(settings["agent"], settings["agent"])
    for name, value in _removed(settings).items():
        if settings.pop(name, value) != value:
            raise InputError(f"{name} is not {value!r}: this setting is no more")
    algorithm = descriptions.read(settings)
    environment = json_files.as_type(Settings, others, "settings")
    return Run(algorithm=algorithm, seed=seed, settings=environment, **own)


def _removed(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that stood beside others and are no more."""
    return {
        name: value
        for name, (beside, value) in _REMOVED.items()
        if settings.keys() >= {*beside}
    }


@functools.cache
def _text(experiment: str) -> str:
    return json.dumps(to_stored(experiment), sort_keys=True)


def write(path: pathlib.Path, records: Mapping[Run, Record]) -> None:
    """Write a file of runs; its bytes do not depend on the order of the runs."""
    ordered = sorted(records, key=lambda run: (_text(run.experiment), run.seed))
    provenance = {x: json.dumps(records[x].provenance, sort_keys=True) for x in ordered}
    experiments = sorted({_text(run.experiment) for run in ordered})
    provenances = sorted(set(provenance.values()))
    index = {
        "experiments": list(map(json.loads, experiments)),
        "provenances": list(map(json.loads, provenances)),
    }
    arrays = {
        "index": np.array(json.dumps(index, sort_keys=True)),
        "experiment": np.array(
            [experiments.index(_text(run.experiment)) for run in ordered]
        ),
        "provenance": np.array([provenances.index(provenance[run]) for run in ordered]),
        "seed": np.array([run.seed for run in ordered], np.uint32),
    }
    for lengths, names in _TABLES.items():
        for name in names:
            columns = [getattr(records[run], name) for run in ordered]
            arrays[lengths] = np.array(list(map(len, columns)))
            arrays[name] = _rounded(name, np.concatenate(columns))
    with output_file.atomic(path) as partial:
        np.savez_compressed(partial, allow_pickle=False, **arrays)


def read(path: pathlib.Path) -> dict[Run, Record]:
    """Return the runs of a file, or raise `InputError` if it can't be read."""
    records = {}
    try:
        arrays = npz.read(path)
        index = json.loads(str(arrays["index"]))
        # A file has thousands of runs of some hundred experiments.
        experiments = list(map(from_stored, index["experiments"]))
        columns = {
            name: np.split(arrays[name].astype(float), np.cumsum(arrays[lengths])[:-1])
            for lengths, names in _TABLES.items()
            for name in names
        }
        for i, seed in enumerate(arrays["seed"]):
            experiment = experiments[arrays["experiment"][i]]
            run = dataclasses.replace(experiment, seed=int(seed))
            provenance = index["provenances"][arrays["provenance"][i]]
            values = {name: column[i] for name, column in columns.items()}
            records[run] = Record(provenance=provenance, **values)
    # What is wrong in a file decides the type of the error.
    except Exception as error:
        why = str(error).partition("\n")[0] or type(error).__name__
        raise InputError(f"{path} is not a file of runs: {why}") from None
    return records


class Store:
    """The runs of a folder, with `run in store`, `store[run]` and `store.add`.

    Attributes:
      folder: the folder.
      answers: what was computed from the runs alone; forgotten when some are added.
    """

    def __init__(self, folder: pathlib.Path):
        self.folder, self.answers = folder, dict[Any, Any]()
        self._records: dict[str, dict[Run, Record]] = {}

    def _path(self, env: str) -> pathlib.Path:
        # A name may have a colon: "brax:ant", or a user's "my_tasks:Line".
        return self.folder / f"{env.replace(':', '-')}.npz"

    def _of(self, env: str) -> dict[Run, Record]:
        if env not in self._records:
            path = self._path(env)
            self._records[env] = read(path) if path.exists() else {}
        return self._records[env]

    def __contains__(self, run: Run) -> bool:
        return run in self._of(run.env)

    def __getitem__(self, run: Run) -> Record:
        return self._of(run.env)[run]

    def missing(self, runs: Iterable[Run]) -> list[Run]:
        """Return the runs that are not stored, each once."""
        return [run for run in dict.fromkeys(runs) if run not in self]

    def add(self, records: Mapping[Run, Record]) -> int:
        """Add the runs that are not stored yet, and return their number."""
        added = 0
        self.answers.clear()
        self.folder.mkdir(parents=True, exist_ok=True)
        for env in sorted({run.env for run in records}):
            with folders.lock(self.folder, seconds=60.0):
                self._records.pop(env, None)
                stored = self._of(env)
                new = {run for run in records if run.env == env} - set(stored)
                if new:
                    stored.update({run: records[run] for run in new})
                    write(self._path(env), stored)
            added += len(new)
        return added
