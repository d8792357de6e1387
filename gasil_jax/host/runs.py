"""A run: the settings that decide its numbers, and a key that identifies it."""

import dataclasses
import functools
import hashlib
import json
from collections.abc import Mapping
from typing import Any

from gasil_jax.algorithms import Algorithm
from gasil_jax.config import ranges
from gasil_jax.errors import InputError
from gasil_jax.host import descriptions, json_files
from gasil_jax.host.environments import Settings

#: Raise this by hand when a change makes the same settings give different numbers, by
#: more than rounding. All earlier runs then count as missing. In version 1, episodes
#: were not staggered.
ALGORITHM_VERSION = 2

#: Settings of an environment that compute the same thing in different ways.
_WAYS = ("physics",)

#: The names of settings in a run's key and in stored runs, where they differ from those
#: here. So a setting can be renamed, and stored runs keep their keys.
STORED_NAMES: Mapping[str, str] = {"initial_std": "initial_deviation"}

#: Settings that are newer than stored runs, of algorithms or of environments, with the
#: value that those runs had, which is the default. A setting with this value is left
#: out of a run's key, so that stored runs keep theirs.
NEWER: Mapping[str, Any] = {
    "max_episode_steps": None,
    "observe_phase": False,
    "action_noise": 0.0,
    "policy_components": 1,
}

#: Settings that are no more: the settings beside which a run had one, and the value
#: that all stored runs have. They stay in a run's key, so that stored runs keep theirs.
REMOVED: Mapping[str, tuple[tuple[str, ...], Any]] = {
    "value_coefficient": (("learning_rate",), 1.0),
    "admission": (("buffer_steps",), "all"),
    "ties": (("buffer_steps",), "oldest"),
    "sample_by_return": (("buffer_steps",), False),
    "buffer_discounts": (("buffer_steps",), True),
    "novelty_ties": (("buffer_steps", "novelty_cell"), "novel"),
    "discriminator_gradient_penalty": (("bonus",), 0.0),
    "discriminator_normalizes_actions": (("bonus",), False),
}


def removed(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that stood beside those of an algorithm and are no more."""
    return {
        name: value
        for name, (beside, value) in REMOVED.items()
        if settings.keys() >= {*beside}
    }


@dataclasses.dataclass(frozen=True)
class Run:
    """The settings that decide the numbers of one training run.

    `start` is the hash of the policy that it starts from, if that is a trained one. The
    physics engine and the device are not among them, because they compute the same
    thing in different ways.
    """

    env: str
    algorithm: Algorithm
    seed: int
    settings: Settings = dataclasses.field(default_factory=Settings)
    algorithm_version: int = ALGORITHM_VERSION
    start: str | None = None

    def __post_init__(self) -> None:
        same = {name: getattr(Settings, name) for name in _WAYS}
        if any(getattr(self.settings, name) != x for name, x in same.items()):
            settings = dataclasses.replace(self.settings, **same)
            object.__setattr__(self, "settings", settings)

    @functools.cached_property
    def _fields(self) -> dict[str, Any]:
        """The settings in the key by name, those of the algorithm in "algorithm"."""
        values = descriptions.describe(self.algorithm)
        if not values["rewards"]:  # Stored runs had no models of the user's.
            del values["rewards"]
        for name, value in values.items():
            if callable(value):
                values[name] = "a function"
            elif name.endswith("_schedule"):
                values[name] = [[float(x) for x in point] for point in value]
        # 1 and 1.0 are the same number, and so the same run.
        for part in self.algorithm.parts:
            for name, allowed in ranges(part).items():
                if values[name] is not None:
                    values[name] = (int if allowed.whole else float)(values[name])
        settings = dataclasses.asdict(self.settings)
        for name in ("obs_noise", "action_noise"):
            settings[name] = float(settings[name])
        for group in (values, settings):
            for name in NEWER.keys() & group.keys():
                if group[name] == NEWER[name]:
                    del group[name]
        return {
            "env": self.env,
            **({"start": self.start} if self.start else {}),
            **{name: x for name, x in settings.items() if name not in _WAYS},
            "algorithm_version": self.algorithm_version,
            "algorithm": {
                **{STORED_NAMES.get(x, x): y for x, y in values.items()},
                **removed(values),
            },
        }

    @functools.cached_property
    def experiment(self) -> str:
        """All settings in the key but the seed, as JSON; a curve's runs share it."""
        return json.dumps(self._fields, sort_keys=True)

    @functools.cached_property
    def key(self) -> str:
        """A hash of the settings, which identifies the run; see `NEWER`."""
        text = f"{self.experiment} {self.seed}"
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @functools.cached_property
    def identity(self) -> tuple[str, int]:
        """What stays the same when training is continued to more steps."""
        return identity(self._fields, self.seed)

    @functools.cached_property
    def shapes(self) -> str:
        """The settings that runs of one compiled program share, as JSON."""
        traced = {STORED_NAMES.get(x, x) for x in self.algorithm.hyperparameters}
        algorithm = {
            name: None if name in traced else value
            for name, value in self._fields["algorithm"].items()
        }
        return json.dumps({**self._fields, "algorithm": algorithm}, sort_keys=True)


def identity(experiment: Mapping[str, Any], seed: int) -> tuple[str, int]:
    """Return `Run.identity` from a parsed `Run.experiment` and a seed."""
    algorithm = {**experiment["algorithm"], "total_steps": None}
    return json.dumps({**experiment, "algorithm": algorithm}, sort_keys=True), seed


def read_run(experiment: Mapping[str, Any], seed: int) -> Run:
    """Return a stored run."""
    fields = dict(experiment)
    own = {name: fields.pop(name) for name in ("env", "algorithm_version")}
    current = {stored: name for name, stored in STORED_NAMES.items()}
    settings = {current.get(x, x): y for x, y in fields.pop("algorithm").items()}
    for name, value in removed(settings).items():
        if settings.pop(name, value) != value:
            raise InputError(f"{name} is not {value!r}: this setting is no more")
    algorithm = descriptions.read(settings)
    environment = json_files.as_type(Settings, fields, "settings")
    return Run(algorithm=algorithm, seed=seed, settings=environment, **own)
