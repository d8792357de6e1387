"""What an experiment trains: trials, each a sweep that can be resumed and divided.

A trial's results are two small files of their own, PANEL/CURVE.csv (returns over
training, a row for each point, seed and part of training) and PANEL/CURVE.json (its
settings and what it ran with), so that each lands as soon as it is there, and several
machines can share an experiment.
"""

import csv
import dataclasses
import itertools
import json
import pathlib
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from gasil_jax import output_file, run_folder, shards, sweep, sweep_tables
from gasil_jax.command_line import InputError

#: The paper's agents, as figures 5 and 7 compare them.
AGENTS = ("ppo", "ppo+bc", "ppo+sil", "ppo+gasil")
#: Those of the figures that compare two: on the point mass and under noise.
PAIR = ("ppo", "ppo+gasil")
TASKS = ("hopper", "walker2d", "halfcheetah", "swimmer", "ant", "humanoid")
RESULTS = pathlib.Path(__file__).parent / "results"

#: Environments that a seed steps at once, together 2,048 steps an iteration.
NUM_ENVS = 32
#: More where physics is slow, for a GPU is fast only with thousands.
NUM_ENVS_OF = {"ant": 64, "humanoid": 64}
# The appendix's values, which a trial's points stand on; no tuned preset.
_FLAGS = ("--preset", "paper")


@dataclasses.dataclass(frozen=True)
class Trial:
    """Seeds x points of one agent in one environment.

    Attributes:
      name: PANEL/CURVE.
      env: environment's name.
      agent: agent's name.
      points: hyperparameters of each, over the appendix's.
      reward_delay: of the environment.
      obs_noise: of the environment.
      seeds: how many.
      first_seed: the number of the first.
      total_steps: of a seed.
      rows: of a seed in the results: so many equal parts of training.
      alpha_schedule: (environment steps, factor of alpha); default always 1.
      normalize_rewards: whether PPO's rewards are.
    """

    name: str
    env: str
    agent: str
    points: tuple[Mapping[str, Any], ...] = ({},)
    reward_delay: int = 1
    obs_noise: float = 0.0
    seeds: int = 10
    first_seed: int = 0
    total_steps: int = 1_000_000
    rows: int = 50
    alpha_schedule: tuple[tuple[float, float], ...] = ()
    normalize_rewards: bool = False

    @property
    def num_envs(self) -> int:
        """Environments that a seed steps at once."""
        return NUM_ENVS_OF.get(self.env, NUM_ENVS)

    def settings(self) -> dict[str, Any]:
        """What decides the results, but for the seeds."""
        fields = dataclasses.asdict(self)
        for name in ("name", "seeds", "first_seed"):
            del fields[name]
        if self.env in NUM_ENVS_OF:
            fields["num_envs"] = self.num_envs
        # Results that are older than these fields have none of them.
        for name in ("alpha_schedule", "normalize_rewards"):
            if not fields[name]:
                del fields[name]
        return fields | {"points": [dict(point) for point in self.points]}


def train(
    trial: Trial, runs: pathlib.Path, part: int, parts: int, flags: Sequence[str] = ()
) -> int:
    """Train a part of a trial or go on with it; returns the exit status.

    Args:
      trial: the whole of it.
      runs: folder of the experiment's runs.
      part: from 1.
      parts: how many; a sweep's shards if more than one.
      flags: more of them, for the sweep's command line.

    Raises:
      InputError: what is there is of other hyperparameters.
    """
    parts = min(parts, len(trial.points) * trial.seeds)
    if part > parts:
        return 0
    place = runs / trial.name
    listed = place.with_name(f"{place.name}.json")
    points = json.dumps([dict(point) for point in trial.points])
    place.parent.mkdir(parents=True, exist_ok=True)
    _check_runs(trial, place)
    if not listed.exists():
        # The points last: where they are, it is said what the runs are of.
        write_whole(_claim(place), json.dumps(_identity(trial)))
        write_whole(listed, points)
    elif json.loads(listed.read_text()) != json.loads(points):
        raise InputError(f"{place} is of other hyperparameters: move it away")
    if (place / "summary.json").exists():
        return 0
    return sweep.main(
        [
            *("--env", trial.env, "--agent", trial.agent, *_FLAGS),
            *("--alpha-schedule", *map(str, itertools.chain(*trial.alpha_schedule))),
            f"--{'' if trial.normalize_rewards else 'no-'}normalize-rewards",
            *("--reward-delay", str(trial.reward_delay)),
            *("--obs-noise", str(trial.obs_noise), "--num-envs", str(trial.num_envs)),
            *("--seeds", str(trial.seeds), "--first-seed", str(trial.first_seed)),
            *("--total-steps", str(trial.total_steps), "--out", str(place)),
            *("--resume", "--points-file", str(listed)),
            *(("--shard", f"{part}/{parts}") if parts > 1 else ()),
            *flags,
        ]
    )


def _claim(place: pathlib.Path) -> pathlib.Path:
    """Where it is written what the runs of a trial are."""
    return place.with_name(f"{place.name}.settings.json")


def _identity(trial: Trial) -> dict[str, Any]:
    return trial.settings() | {"seeds": trial.seeds, "first_seed": trial.first_seed}


def _check_runs(trial: Trial, place: pathlib.Path) -> None:
    """Raise `InputError` if the runs are of other settings or seeds."""
    if not _claim(place).exists():
        return
    before = json.loads(_claim(place).read_text())
    now = json.loads(json.dumps(_identity(trial)))
    for name in sorted(set(before) | set(now)):
        was, is_ = before.get(name), now.get(name)
        if was != is_:
            # Points are too many for a line.
            values = "" if name == "points" else f" ({was}, not {is_})"
            raise InputError(f"{place} has other {name}{values}: move {place}* away")


def collect(trial: Trial, runs: pathlib.Path, results: pathlib.Path) -> None:
    """Put what has been trained of a trial into its results.

    Rows that are there already, of another machine, stay.

    Raises:
      InputError: the results or the runs are of other settings.
    """
    _check_runs(trial, runs / trial.name)
    target = results / f"{trial.name}.csv"
    described = target.with_suffix(".json")
    rows: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in _read(target):
        rows.setdefault((row["point"], row["seed"]), []).append(row)
    made = []
    if target.exists():
        check(trial, results)
        made = json.loads(described.read_text())["made"]
    found = len(rows)
    place = runs / trial.name
    for trained in map(_trained, [place, *sorted(shards.root(place).glob("*-of-*"))]):
        if trained is None:
            continue
        new = dict(_rows(trial, trained))
        if added := {int(seed) for point, seed in set(new) - set(rows)}:
            _record(made, _made(trained), added)
        rows = new | rows
    if len(rows) > found:
        target.parent.mkdir(parents=True, exist_ok=True)
        in_order = sorted(rows, key=lambda key: tuple(map(int, key)))
        content = {"settings": trial.settings(), "made": made}
        # The CSV file last: where it is, its settings are.
        write_whole(described, json.dumps(content, indent=2) + "\n")
        _write_rows(target, [row for key in in_order for row in rows[key]])


def _write_rows(target: pathlib.Path, rows: Iterable[Mapping[str, Any]]) -> None:
    with output_file.whole(target) as partial, partial.open("w", newline="") as file:
        writer = csv.DictWriter(file, _COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def write_whole(path: pathlib.Path, text: str) -> None:
    """Write a file that others may be reading or writing."""
    with output_file.whole(path) as partial:
        partial.write_text(text)


def _is_of(trial: Trial, described: pathlib.Path) -> bool:
    settings = json.loads(described.read_text())["settings"]
    return bool(settings == json.loads(json.dumps(trial.settings())))


def check(trial: Trial, results: pathlib.Path) -> None:
    """Raise `InputError` if the results of that name are of other settings."""
    target = results / f"{trial.name}.csv"
    if target.exists() and not _is_of(trial, target.with_suffix(".json")):
        raise InputError(f"{target} is of other settings: move it away")


def known(trial: Trial, results: pathlib.Path) -> frozenset[tuple[int, int]]:
    """(point, seed) of each run that the results have."""
    rows = _read(results / f"{trial.name}.csv")
    return frozenset((int(row["point"]), int(row["seed"])) for row in rows)


def adopt(trial: Trial, results: pathlib.Path) -> None:
    """Take over what another figure beside `results` has of the very same runs.

    Runs that are there already stay: it must have those too, to the digit.
    """
    target = results / f"{trial.name}.csv"
    described = target.with_suffix(".json")
    if target.exists() and not _is_of(trial, described):
        return
    if read_whole(trial, results) is not None:
        return
    here = {tuple(row.items()) for row in _read(target)}
    seeds = range(trial.first_seed, trial.first_seed + trial.seeds)
    for there in sorted(results.parent.glob("*/*/[!.]*.json")):
        if not _is_of(trial, there):
            continue
        name = str(there.relative_to(results.parent).with_suffix(""))
        if read_whole(dataclasses.replace(trial, name=name), results.parent) is None:
            continue
        rows = _read(there.with_suffix(".csv"))
        rows = [row for row in rows if int(row["seed"]) in seeds]
        if here <= {tuple(row.items()) for row in rows}:
            target.parent.mkdir(parents=True, exist_ok=True)
            write_whole(described, there.read_text())
            _write_rows(target, rows)
            return


_COLUMNS = ("point", "seed", "env_steps", "episode_return")


def _read(path: pathlib.Path) -> list[dict[str, str]]:
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def _trained(folder: pathlib.Path) -> sweep_tables.Trained | None:
    """A sweep or shard that has ended; None where there is none."""
    if not run_folder.is_described(folder):
        return None
    described = run_folder.read(folder)
    if described["shard"] is None and shards.root(folder).is_dir():
        return None  # The tables of shards, which are read themselves.
    trained = sweep_tables.Trained.described(folder, described)
    return None if trained.unfinished() else trained


def _rows(
    trial: Trial, trained: sweep_tables.Trained
) -> Iterable[tuple[tuple[str, str], list[dict[str, Any]]]]:
    """(point, seed) -> rows of the results."""
    for (point, seed), metrics in trained.members().items():
        returns, steps = metrics["episode_return"], metrics["env_steps"]
        rows = []
        for part in np.array_split(np.arange(len(steps)), trial.rows):
            if not len(part):
                continue
            seen = returns[part][np.isfinite(returns[part])]
            mean = f"{seen.mean():.6g}" if len(seen) else ""
            values = (point, seed, int(steps[part[-1]]), mean)
            rows.append(dict(zip(_COLUMNS, values, strict=True)))
        yield (str(point), str(seed)), rows


def _record(made: list[dict[str, Any]], by: Mapping[str, Any], seeds: set[int]) -> None:
    """Add to what made a trial's results: by what and which seeds."""
    for entry in made:
        # None of results from before they were recorded.
        if (before := entry.get("seeds")) and {**entry, **by} == entry:
            entry["seeds"] = sorted(seeds.union(before))
            return
    made.append({**by, "seeds": sorted(seeds)})


def _made(trained: sweep_tables.Trained) -> dict[str, Any]:
    described = run_folder.read(trained.folder)
    return {
        "physics": described["settings"].physics,
        "versions": trained.trainings()[0]["versions"],
        "commit": _commit(),
    }


def _commit() -> str | None:
    """The checkout's commit, with a "+" where files differ from it."""
    asked = ("git", "describe", "--always", "--abbrev=12", "--dirty=+")
    try:
        said = subprocess.run(
            asked, cwd=pathlib.Path(__file__).parent, capture_output=True, text=True
        )
    except OSError:
        return None
    return said.stdout.strip() or None


@dataclasses.dataclass(frozen=True)
class Results:
    """What is known of a trial.

    Attributes:
      trial: which.
      seeds: their numbers, (seeds,): those of the trial's that every point has.
      env_steps: (rows,), at the end of each part of training.
      returns: (points, seeds, rows), NaN where no episode ended.
      made: by what, and which seeds, where that is known.
    """

    trial: Trial
    seeds: np.ndarray
    env_steps: np.ndarray
    returns: np.ndarray
    made: Sequence[Mapping[str, Any]]

    @property
    def complete(self) -> bool:
        """Whether all seeds of the trial are there."""
        return len(self.seeds) >= self.trial.seeds

    def after(self, seeds: int) -> "Results":
        """The seeds that come after the first so many, alone."""
        return dataclasses.replace(
            self, seeds=self.seeds[seeds:], returns=self.returns[:, seeds:]
        )

    @property
    def final(self) -> np.ndarray:
        """Mean return over the last tenth of training, (points, seeds)."""
        return self.part(0.9, 1.0)

    def part(self, begin: float, end: float) -> np.ndarray:
        """Mean return over a part of training, from share to share, (points, seeds).

        Of the rows whose middle is in it (a row's end may be just past a round share),
        or of the row that the part's own middle is in.
        """
        ends = self.env_steps / self.env_steps[-1]
        middle = (np.concatenate([[0.0], ends[:-1]]) + ends) / 2
        chosen = (middle > begin) & (middle <= end)
        if not chosen.any():
            chosen[np.searchsorted(ends, (begin + end) / 2)] = True
        rows = self.returns[..., chosen]
        count = np.isfinite(rows).sum(axis=-1)
        return np.where(count > 0, np.nansum(rows, -1) / np.maximum(count, 1), np.nan)


def read_whole(trial: Trial, results: pathlib.Path) -> Results | None:
    """`read`, where all seeds of the trial are complete; None elsewhere."""
    found = read(trial, results)
    return found if found is not None and found.complete else None


def read(trial: Trial, results: pathlib.Path) -> Results | None:
    """The results of a trial's seeds; None where none is complete, or other settings.

    A file may have more seeds than the trial, whose own are read.
    """
    target = results / f"{trial.name}.csv"
    rows = _read(target)
    if rows and not _is_of(trial, target.with_suffix(".json")):
        return None
    seeds_of: dict[int, set[int]] = {}
    for row in rows:
        seeds_of.setdefault(int(row["point"]), set()).add(int(row["seed"]))
    if set(seeds_of) != set(range(len(trial.points))):
        return None
    wanted = set(range(trial.first_seed, trial.first_seed + trial.seeds))
    seeds = sorted(wanted.intersection(*seeds_of.values()))
    if not seeds:
        return None
    steps = sorted({int(row["env_steps"]) for row in rows})
    returns = np.full((len(trial.points), len(seeds), len(steps)), np.nan)
    for row in rows:
        if int(row["seed"]) in seeds and row["episode_return"]:
            place = (
                int(row["point"]),
                seeds.index(int(row["seed"])),
                steps.index(int(row["env_steps"])),
            )
            returns[place] = float(row["episode_return"])
    described = json.loads(target.with_suffix(".json").read_text())
    return Results(
        trial=trial,
        seeds=np.array(seeds),
        env_steps=np.array(steps),
        returns=returns,
        made=described["made"],
    )
