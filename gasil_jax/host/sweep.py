"""What a folder of training holds: points and seeds, described by its config.json.

A point is a set of changed settings (a trial, in the words of other packages), a run is
a point with a seed, and the runs that share shapes are a program, one vmapped batch. A
sweep is all runs of some points and seeds. `gasil_jax.run` trains a sweep of one point.

    config.json         the sweep
    programs/NAME/      a program: its runs, tables, checkpoints
    results.csv, ...    what `results` makes of them once no run is missing

Continuing a folder is training the runs that are missing. Uniting two folders is
copying the programs of one into programs/ of the other and continuing that.
"""

import contextlib
import dataclasses
import functools
import hashlib
import pathlib
import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, Required, TypedDict

import jax

from gasil_jax import algorithms
from gasil_jax.algorithms import Algorithm
from gasil_jax.config import count
from gasil_jax.errors import InputError, refusal, shown
from gasil_jax.host import (
    descriptions,
    environments,
    folders,
    json_files,
    points,
    programs,
    trackers,
)
from gasil_jax.host.environments import Settings
from gasil_jax.host.output_file import note
from gasil_jax.host.points import Point
from gasil_jax.host.programs import Program
from gasil_jax.host.runs import Run

#: The columns of tables that identify a member.
LABELS = ("point", "seed")
#: The largest number of seeds. Their absolute numbers are below 2**32.
MOST_SEEDS = 2**20


@dataclasses.dataclass(frozen=True)
class Recording:
    """What is recorded of training, and when. It does not change a run's numbers.

    Attributes:
      checkpoint_every: environment steps per seed between two checkpoints; by
        default a checkpoint is written every ten minutes.
      keep_checkpoints: number of newest checkpoints to keep. One more is kept: the one
        with the best evaluation or, without evaluate_every, with the best returns.
      evaluate_every: environment steps per seed between two evaluations of the
        policy's mean action in fresh environments, rounded up to whole iterations;
        by default none. The untrained policy is evaluated too. The scores are undelayed
        returns, in evaluations.csv.
      evaluate_episodes: episodes per seed in each evaluation.
      video_every: environment steps per seed between two films of the first seed's
        policy, rounded up to whole iterations; by default none. They are in videos/ and
        where `log` logs.
      log: trackers to log to besides metrics.csv: tensorboard, wandb.
    """

    checkpoint_every: int | None = count(None)
    keep_checkpoints: int = count(2)
    evaluate_every: int | None = count(None)
    evaluate_episodes: int = count(10)
    video_every: int | None = count(None)
    log: tuple[str, ...] = dataclasses.field(
        default=(), metadata={"check": trackers.check}
    )


@dataclasses.dataclass(frozen=True)
class Start:
    """The trained policy that runs start from."""

    run: str  # the folder of its run
    seed: int
    sha256: str  # hash of its checkpoint


@dataclasses.dataclass(frozen=True)
class Sweep:
    """The points and seeds of a folder."""

    env: str
    algorithm: Algorithm  # the algorithm that the points change
    seeds: Sequence[int]  # absolute seed numbers
    # Changed settings, by name; all have the same names.
    points: Sequence[Point] = ({},)
    settings: Settings = dataclasses.field(default_factory=Settings)
    recording: Recording = dataclasses.field(default_factory=Recording)
    preset: str | None = None  # name of the preset that the settings began with
    # Why no command line can make the environment or the algorithm again; None if one
    # can.
    only_python: str | None = None
    # Those of further agents, trained beside it. Then each point has its "agent".
    others: Sequence[Algorithm] = ()
    # The trained policy that all runs start from; None starts from scratch.
    start: Start | None = None

    @property
    def algorithms(self) -> tuple[Algorithm, ...]:
        """The algorithms of all agents."""
        return (self.algorithm, *self.others)

    @property
    def agent(self) -> str:
        """The names of all agents, separated by commas."""
        return ",".join(x.agent.name for x in self.algorithms)

    @functools.cached_property
    def runs(self) -> Mapping[tuple[int, int], Run]:
        """The run of each (index of the point, seed)."""
        every = [points.algorithm_of(x, self.algorithms) for x in self.points]
        changed = [algorithm.replace(**values) for algorithm, values in every]
        start = None if self.start is None else self.start.sha256
        return {
            (index, seed): Run(self.env, algorithm, seed, self.settings, start=start)
            for index, algorithm in enumerate(changed)
            for seed in self.seeds
        }

    def part(self, number: int = 1, count: int = 1) -> list[Run]:
        """Return the runs of shard `number`, counted from 1, of `count` shards.

        They do not depend on which runs are trained already. The sizes of shards differ
        by one run at most, and the runs of a program are divided as little as possible.
        """
        ordered = [x for each in programs.group(self.runs.values()) for x in each.runs]
        total = len(ordered)
        if count > total:
            raise InputError(
                f"shard is {number}/{count}: {total} runs (points x seeds) make "
                f"{total} shards at most"
            )
        return ordered[(number - 1) * total // count : number * total // count]

    def stored(self, folder: pathlib.Path) -> list[Program]:
        """Return the programs in the sweep's folder that hold runs of it."""
        return programs.read(folder / "programs", self.runs.values())

    def trained(self, folder: pathlib.Path) -> list[Program]:
        """Return the programs that are trained to their end."""
        return [x for x in self.stored(folder) if x.is_finished]

    def missing(self, trained: Iterable[Program]) -> list[tuple[int, int]]:
        """Return the (index of the point, seed) of each run that no program has."""
        done = {run for each in trained for run in each.runs}
        return [member for member, run in self.runs.items() if run not in done]

    def unfinished(
        self, folder: pathlib.Path, requested: Collection[Run] | None = None
    ) -> list[Program]:
        """Return the programs to train for requested runs, by default all."""
        every = list(self.runs.values()) if requested is None else requested
        asked, member_of = set(every), {run: x for x, run in self.runs.items()}
        held = [x for x in self.stored(folder) if not asked.isdisjoint(x.runs)]
        begun, others = programs.unfinished(every, held)
        new = [
            x.below(
                folder / "programs",
                dict(zip(LABELS, zip(*(member_of[run] for run in x.runs)))),
            )
            for x in programs.group(others)
        ]
        return [*begun, *new]

    def write(self, folder: pathlib.Path) -> None:
        """Write config.json."""
        algorithm, *others = map(descriptions.describe, self.algorithms)
        content = {
            "env": self.env,
            "settings": self.settings,
            "algorithm": algorithm,
            "others": others,
            "points": [dict(point) for point in self.points],
            "seeds": list(self.seeds),
            "recording": self.recording,
            "preset": self.preset,
            "start": self.start,
            "only_python": self.only_python,
            "expert_sha256": _expert_hash(self),
        }
        json_files.write(folder / folders.CONFIG, content)

    def begun_in(
        self, folder: pathlib.Path, *, resume: bool, option: str = "out"
    ) -> "Sweep":
        """Write config.json, and return this sweep as `continued_from` does."""
        with folders.lock(folder, option=option, seconds=60.0):
            if not resume or not folders.has_config(folder):
                folders.refuse_used(folder, option=option)
            grown = self.continued_from(folder, option=option)
            grown.write(folder)
        return grown

    def continued_from(self, folder: pathlib.Path, *, option: str = "out") -> "Sweep":
        """Return this sweep with the points of the one in the folder before its own.

        If none has begun there, it is this one. What is there must be the same but for
        longer training and more seeds and points.
        """
        if not folders.has_config(folder):
            return self
        stored = described(folder)
        if changed := _differences(stored, self):
            raise InputError(
                f"{option} is {folder}, where {'; '.join(changed)}: only total_steps "
                "and seeds may grow, and only checkpoint_every, keep_checkpoints, "
                "video_every, devices and log may differ"
            )
        every = points.completed([*stored["points"], *self.points], *self.algorithms)
        return dataclasses.replace(self, points=every, start=stored.get("start"))


class Config(TypedDict, total=False):
    """The content of config.json."""

    env: Required[str]
    settings: Required[Settings]
    algorithm: Required[dict[str, Any]]
    others: tuple[dict[str, Any], ...]
    points: Required[tuple[dict[str, float | str], ...]]
    seeds: Required[tuple[int, ...]]
    recording: Required[Recording]
    preset: Required[str | None]
    only_python: Required[str | None]
    start: Start | None
    expert_sha256: str | None


def described(folder: pathlib.Path) -> Config:
    """Return the content of config.json, also of what only Python can make."""
    path = folder if folder.is_file() else folder / folders.CONFIG
    try:
        content: Config = json_files.read(path, Config)
    except (FileNotFoundError, NotADirectoryError):
        why = f"has no {folders.CONFIG}" if folder.exists() else "does not exist"
        raise InputError(
            f"run is {folder}, which {why}: it must be the folder of a run or a sweep"
        ) from None
    with json_files.blamed(path):
        if not content["points"]:
            raise ValueError("it has no points")
        check_seeds(content["seeds"])
    return content


def read(folder: pathlib.Path, algorithm: Algorithm | None = None) -> Sweep:
    """Return the sweep in a folder, with an algorithm that only Python can make."""
    return made(folder, described(folder), algorithm)


def made(
    folder: pathlib.Path, stored: Config, algorithm: Algorithm | None = None
) -> Sweep:
    """Return the sweep that a folder's config.json describes; see `read`."""
    if algorithm is None and (why := stored["only_python"]) is not None:
        raise InputError(
            f"run is {folder}, which was trained from Python with what no command line "
            f"can name ({why}): use gasil_jax.fit, gasil_jax.load_policy or "
            "python -m gasil_jax.plot"
        )
    with json_files.blamed(folder / folders.CONFIG):
        _note_imports(folder, stored)
        if algorithm is None:
            algorithm = descriptions.read(stored["algorithm"])
        others = tuple(map(descriptions.read, stored.get("others", ())))
        for each in (algorithm, *others):
            algorithms.check(each)
        points.check(stored["points"], algorithm, *others, source="points: ")
        every = points.completed(stored["points"], algorithm, *others)
    names = ("env", "settings", "seeds", "recording", "preset", "only_python")
    fields: dict[str, Any] = {name: stored[name] for name in names}  # type: ignore[literal-required]
    fields |= {"others": others, "start": stored.get("start")}
    return Sweep(algorithm=algorithm, points=every, **fields)


def _note_imports(folder: pathlib.Path, stored: Config) -> None:
    """Print which modules a config.json names, which its reader imports."""
    named: list[Any] = [stored["env"]]
    for each in (stored["algorithm"], *stored.get("others", ())):
        named += [each.get("agent"), *each.get("rewards", ())]
    modules = {str(name).partition(":")[0] for name in named if ":" in str(name)}
    new = sorted(modules - {*environments.FAMILIES, *sys.modules})
    if new:
        note(f"{folder} names code that is imported now: {', '.join(new)}")


def check_seeds(seeds: Sequence[int]) -> None:
    """Raise `InputError` unless these are different numbers of seeds."""
    if not 1 <= len(seeds) <= MOST_SEEDS:
        raise refusal("seeds", len(seeds), f"from 1 to {MOST_SEEDS:,}")
    if not all(0 <= x < 2**32 for x in seeds) or len(set(seeds)) < len(seeds):
        each = f"different whole numbers from 0 to {2**32 - 1}"
        raise refusal("seeds", list(seeds), each)


def _differences(before: Config, now: Sweep) -> list[str]:
    """Return "NAME was A, is B" for each field in which two sweeps must not differ."""
    old, new = (before["algorithm"], *before.get("others", ())), now.algorithms
    agents = ",".join(str(x.get("agent")) for x in old)
    if agents != now.agent:
        return [f"agent was {agents}, is {now.agent}"]
    evaluations = ("evaluate_every", "evaluate_episodes")
    recordings = (before["recording"], now.recording)
    changes = []
    for was, then in (
        ({"env": before["env"]}, {"env": now.env}),
        (vars(before["settings"]), vars(now.settings)),
        *zip(old, map(descriptions.describe, new), strict=True),
        [{x: getattr(each, x) for x in evaluations} for each in recordings],
    ):
        for name, value in was.items():
            if name in ("total_steps", "expert"):
                continue
            if json_files.as_type(Any, value, name) != (other := then.get(name)):
                changes.append(f"{name} was {shown(value)}, is {shown(other)}")
    if now.algorithm.config.total_steps < old[0]["total_steps"]:
        changes.append(f"total_steps was {old[0]['total_steps']}")
    if not set(before["seeds"]) <= set(now.seeds):
        changes.append(f"seeds were {shown(list(before['seeds']))}")
    start = before.get("start")
    if now.start and (start is None or start.sha256 != now.start.sha256):
        changes.append(f"init_from was {start and start.run}, is {now.start.run}")
    if before.get("expert_sha256") != _expert_hash(now):
        changes.append("the trajectories of the expert were others")
    return changes


def _expert_hash(sweep: Sweep) -> str | None:
    """Return the hash of the experts' trajectories, None without an expert."""
    agents = [x.agent for x in sweep.algorithms if getattr(x.agent, "expert", None)]
    digest = hashlib.sha256()
    for values in jax.tree.leaves([agent.data() for agent in agents]):
        digest.update(values.tobytes())
    return digest.hexdigest() if agents else None


def parse_shard(text: str) -> tuple[int, int]:
    """Return the number of a shard, from 1 on, and their count, from "3/8"."""
    with contextlib.suppress(ValueError):
        number, count = map(int, text.split("/"))
        if 1 <= number <= count and text == f"{number}/{count}":
            return number, count
    raise InputError(
        f"shard is {text!r}: it must be NUMBER/COUNT, such as 1/8 up to 8/8"
    )
