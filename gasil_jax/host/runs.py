"""A run: the settings that decide its numbers, and a key that identifies it."""

import dataclasses
import functools
import hashlib
import json
from collections.abc import Mapping
from typing import Any

from gasil_jax.algorithms import Algorithm
from gasil_jax.config import ranges
from gasil_jax.host import descriptions
from gasil_jax.host.environments import Settings

#: Raise this by hand when a change makes the same settings give different numbers, by
#: more than rounding. All earlier runs then count as missing. In version 1, episodes
#: were not staggered.
ALGORITHM_VERSION = 2

#: Settings of an environment that compute the same thing in different ways.
_WAYS = ("physics",)


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
        for name, value in values.items():
            if name.endswith("_schedule") and value != "a function":
                values[name] = [[float(x) for x in point] for point in value]
        # 1 and 1.0 are the same number, and so the same run.
        for part in self.algorithm.parts:
            for name, allowed in ranges(part).items():
                if values[name] is not None:
                    values[name] = (int if allowed.whole else float)(values[name])
        settings = dataclasses.asdict(self.settings)
        for name in ("obs_noise", "action_noise"):
            settings[name] = float(settings[name])
        return {
            "env": self.env,
            **({"start": self.start} if self.start else {}),
            **{name: x for name, x in settings.items() if name not in _WAYS},
            "algorithm_version": self.algorithm_version,
            "algorithm": values,
        }

    @functools.cached_property
    def experiment(self) -> str:
        """All settings in the key but the seed, as JSON; a curve's runs share it."""
        return json.dumps(self._fields, sort_keys=True)

    @functools.cached_property
    def key(self) -> str:
        """A hash of the settings, which identifies the run."""
        text = f"{self.experiment} {self.seed}"
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @functools.cached_property
    def identity(self) -> tuple[str, int]:
        """What stays the same when training is continued to more steps."""
        return identity(self._fields, self.seed)

    @functools.cached_property
    def shapes(self) -> str:
        """The settings that runs of one compiled program share, as JSON."""
        traced = self.algorithm.hyperparameters
        algorithm = {
            name: None if name in traced else value
            for name, value in self._fields["algorithm"].items()
        }
        return json.dumps({**self._fields, "algorithm": algorithm}, sort_keys=True)


def identity(experiment: Mapping[str, Any], seed: int) -> tuple[str, int]:
    """Return `Run.identity` from a parsed `Run.experiment` and a seed."""
    algorithm = {**experiment["algorithm"], "total_steps": None}
    return json.dumps({**experiment, "algorithm": algorithm}, sort_keys=True), seed
