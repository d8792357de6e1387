"""Train the runs that are missing in a store, and add them to it.

Runs with the same environment and static settings are members of one compiled program,
which is trained in a scratch folder as a program of a sweep is in its own. Interrupted
training is only continued if `Setup.resume` is set.
"""

import dataclasses
import functools
import json
import math
import multiprocessing
import os
import pathlib
import signal
import subprocess
import sys
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from multiprocessing import connection
from typing import Any, Literal

import jax
import numpy as np

from experiments.search import FINALIST_SEEDS
from experiments.store import Record, Store
from gasil_jax.cli.parsing import input_checked
from gasil_jax.errors import InputError
from gasil_jax.host import driver, folders, interruption, json_files, programs, training
from gasil_jax.host.programs import Program
from gasil_jax.host.runs import Run
from gasil_jax.host.sweep import Recording, Sweep

#: Equal parts of training in a record, and evaluations during training.
ROWS, EVALUATIONS = 50, 10
#: Files and folders of the checkout that experiments write.
_WRITTEN = (
    *(
        "experiments/results",
        "docs/results",
        "README.md",
        "gasil_jax/tuned_presets.json",
    ),
    *("gasil_jax/zoo", "docs/data.md"),
)
#: The file of a scratch folder that says how each session trained.
_SESSIONS = "provenance.json"
_HOW_TO_CONTINUE = "continue with: the same command and --resume"
_SECONDS_BETWEEN_POLLS = 1.0


@dataclasses.dataclass(frozen=True)
class Setup:
    """The settings of training that do not decide a run's numbers.

    Attributes:
      runs: scratch folder of the training in progress.
      resume: whether interrupted training in it is continued; otherwise it is refused.
      physics: physics engine of locomotion.
      devices: number of CPU devices to shard members over; default one per core.
      evaluate_episodes: episodes of each evaluation during training; 0 for none. Runs
        of a search are not evaluated.
      processes: number of programs that are trained at once, each by a process on one
        core, which is fastest where each run has few environments. With 1 the program's
        runs are sharded over `devices`.
      members: largest number of runs in a program; default no limit.
      commit: commit of the code, to be recorded if there is no repository.
    """

    runs: pathlib.Path = pathlib.Path("runs", "experiments")
    resume: bool = False
    physics: Literal["jax", "mjx", "mujoco"] = "jax"
    devices: int | None = None
    evaluate_episodes: int = 10
    processes: int = 1
    members: int | None = None
    commit: str | None = None

    @property
    def scratch(self) -> pathlib.Path:
        """The folder of programs in training; their tables depend on what it names."""
        return self.runs / f"{self.physics}-{self.evaluate_episodes}"


@functools.cache
def source(commit: str | None) -> dict[str, Any]:
    """Return the checkout's commit, and whether it has changes of other files."""

    def git(*arguments: str) -> str:
        command = ("git", "-C", str(pathlib.Path(__file__).parent.parent), *arguments)
        return subprocess.check_output(command, stderr=subprocess.DEVNULL, text=True)

    written = [f":!{path}" for path in _WRITTEN]
    try:
        changed = git("status", "--porcelain", "--", ".", *written)
        newest = git("rev-parse", "--short=12", "HEAD").strip()
    except (OSError, subprocess.CalledProcessError):
        return {"commit": commit, "clean": None}
    return {"commit": newest, "clean": not changed}


def title(program: Program) -> str:
    """Return a short description of a program's runs."""
    run, count = program.runs[0], len(program.runs)
    config, delay = run.algorithm.config, run.settings.reward_delay
    words = [f"{run.env} {run.algorithm.agent.name}"]
    words += [f"{config.num_envs} environments"]
    words += [f"delayed {delay}"] if delay > 1 else []
    noise = run.settings.action_noise
    words += [f"noise {noise:g} on actions"] if noise else []
    words += [] if config.stagger_episodes else ["in step"]
    words += [f"seed {run.seed}" if count == 1 else f"{count} runs"]
    return ", ".join(words)


def select_by_key(runs: Iterable[Run], number: int, count: int) -> list[Run]:
    """Return the runs of one of `count` shards, whichever other runs are missing."""
    return [x for x in runs if int(x.key, 16) % count == number - 1]


def unfinished(missing: Sequence[Run], setup: Setup) -> list[Program]:
    """Return the programs to train: those that have begun, then by their first run."""
    rank = {run: rank for rank, run in enumerate(missing)}
    # The order in which runs are missing does not change a program.
    ordered = sorted(rank, key=lambda run: run.key)
    begun, others = programs.unfinished(ordered, programs.read(setup.scratch, ordered))
    groups = programs.group(others, setup.members, lambda x: x.seed in FINALIST_SEEDS)
    new = [
        x.below(setup.scratch, {"member": range(len(x.runs)), "seed": x.seeds})
        for x in groups
    ]
    for each in (begun, new):
        each.sort(key=lambda program: min(rank.get(run, 0) for run in program.runs))
    return [*begun, *new]


def train(stored: Program, setup: Setup) -> dict[Run, Record]:
    """Train a program, or continue its training, and return its runs' records."""
    run = stored.runs[0]
    of_search = run.seed in FINALIST_SEEDS
    episodes = None if of_search else setup.evaluate_episodes or None
    total_steps = run.algorithm.config.total_steps
    recording = Recording(
        keep_checkpoints=1,
        evaluate_every=episodes and math.ceil(total_steps / EVALUATIONS),
        evaluate_episodes=episodes or Recording.evaluate_episodes,
    )
    settings = dataclasses.replace(run.settings, physics=setup.physics)
    sweep = Sweep(
        run.env, run.algorithm, (run.seed,), settings=settings, recording=recording
    )
    with input_checked():
        env = training.prepare(sweep, [stored], num_devices=setup.devices)
    _add_session(stored, setup)
    with (
        interruption.noted(_HOW_TO_CONTINUE),
        interruption.Interruption() as received,
    ):
        (outcome,) = training.train_programs(
            env, [stored], recording, title=title(stored), interruption=received
        )
    if outcome.unsaved is not None:
        raise outcome.unsaved
    return records(stored)


def records(stored: Program) -> dict[Run, Record]:
    """Return the records of a program that is trained to its end."""
    provenance, every = _provenance(stored), zip(stored.runs, stored.tables())
    return {run: record(*own, provenance) for run, own in every}


def _sessions(stored: Program) -> list[dict[str, Any]]:
    path = stored.path / _SESSIONS
    return json.loads(path.read_text())["sessions"] if path.exists() else []


def _add_session(stored: Program, setup: Setup) -> None:
    """Add to a program's provenance.json how it is trained in this process."""
    devices = jax.devices()[: len(stored.runs)]
    now = {
        # Stored runs from before 2026-11-29 say "mjx" where this says "jax".
        "physics": setup.physics,
        "device": f"{len(devices)} x {devices[0].device_kind}",
        "versions": driver.versions(),
        **source(setup.commit),
    }
    if now not in (sessions := _sessions(stored)):
        path = folders.create(stored.path) / _SESSIONS
        json_files.write(path, {"sessions": [*sessions, now]})


def _provenance(stored: Program) -> dict[str, Any]:
    """Return how a program was trained, over all sessions of interrupted training."""
    sessions = _sessions(stored)
    joined = dict(sessions[-1])
    for name in ("device", "commit"):
        different = dict.fromkeys(x[name] for x in sessions if x[name])
        joined[name] = ", then ".join(different) or None
    # False if any session had a changed checkout; otherwise None if any is unknown.
    joined["clean"] = min((x["clean"] for x in sessions), key=[False, None, True].index)
    return joined


def record(
    metrics: Mapping[str, np.ndarray],
    evaluations: Mapping[str, np.ndarray],
    provenance: Mapping[str, Any],
) -> Record:
    """Return a run's record from the columns of its tables, (rows,) each."""
    steps = metrics["env_steps"]
    parts = [x for x in np.array_split(np.arange(len(steps)), ROWS) if len(x)]

    def means(name: str) -> np.ndarray:
        every = [metrics[name][part] for part in parts]
        finite = [values[np.isfinite(values)] for values in every]
        return np.array([x.mean() if len(x) else np.nan for x in finite])

    # That of the untrained policy is not stored.
    scores = {x: y[evaluations["env_steps"] > 0] for x, y in evaluations.items()}
    return Record(
        env_steps=np.array([steps[part[-1]] for part in parts]),
        episode_return=means("episode_return"),
        episode_length=means("episode_length"),
        provenance=provenance,
        evaluation_steps=scores.get("env_steps", np.empty(0)),
        evaluation_return=scores.get("mean", np.empty(0)),
    )


def _requested(missing: Sequence[Run], store: Store, setup: Setup) -> list[Program]:
    """Return the programs that train the missing runs; store those that are trained."""
    asked = set(missing)
    begun = programs.read(setup.scratch, missing)
    used = [x for x in begun if not asked.isdisjoint(x.runs)]
    if used and not setup.resume:
        raise InputError(
            f"runs is {setup.runs}, which holds training of these runs in "
            f"{', '.join(x.path.name for x in used)}: continue it with --resume, or "
            "name another folder"
        )
    for each in used:
        # It was stopped before its runs were stored.
        if each.is_finished:
            store.add(records(each))
    return unfinished(missing, setup)


def train_missing(missing: Sequence[Run], store: Store, setup: Setup) -> None:
    """Train runs and add them to the store, each program as soon as it has ended."""
    for stored in _requested(missing, store, setup):
        # Another process may have added them since.
        if Store(store.folder).missing(stored.runs):
            store.add(train(stored, setup))


def _train_on_core(core: int, stored: Program, setup: Setup, folder: Any) -> None:
    """Train a program on one core; what this process prints goes to a log file."""
    # Training answers the first signal by saving. A cluster, a terminal and the parent
    # may each send one.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    os.sched_setaffinity(0, {core})
    with open(f"{stored.path}.log", "a") as log:
        for stream in (sys.stdout, sys.stderr):
            os.dup2(log.fileno(), stream.fileno())
        Store(folder).add(train(stored, setup))


def _end(processes: Collection[Any]) -> None:
    """End processes, and wait until they have saved; a second Ctrl-C kills them."""
    try:
        while alive := [x for x in processes if x.is_alive()]:
            for process in alive:
                process.terminate()
            alive[0].join(_SECONDS_BETWEEN_POLLS)
    finally:
        for process in processes:
            process.kill()


def train_in_processes(
    missing: Callable[[], Sequence[Run]], store: Store, setup: Setup
) -> None:
    """Train runs as `train_missing` in processes, and ask again for what is missing."""
    cores = sorted(os.sched_getaffinity(0))
    if setup.processes > len(cores):
        raise InputError(
            f"processes is {setup.processes}: it must be at most the number of cores, "
            f"{len(cores)}"
        )
    setup.scratch.mkdir(parents=True, exist_ok=True)
    free, failed = cores[: setup.processes], list[Program]()
    running: dict[Any, tuple[Any, Program, int]] = {}
    start = multiprocessing.get_context("spawn").Process
    with (
        interruption.noted(_HOW_TO_CONTINUE),
        interruption.Interruption() as received,
    ):
        while True:
            begun = [*failed, *(stored for _, stored, _ in running.values())]
            begun_here = {run for each in begun for run in each.runs}
            waiting = [run for run in missing() if run not in begun_here]
            for stored in _requested(waiting, store, setup)[: len(free)]:
                arguments = (free.pop(), stored, setup, store.folder)
                process = start(target=_train_on_core, args=arguments)
                process.start()
                running[process.sentinel] = process, stored, arguments[0]
            if not running:
                break
            ended: list[Any] = []
            while not ended and received.signal is None:
                ended = connection.wait(list(running), _SECONDS_BETWEEN_POLLS)
            if received.signal is not None:
                _end([process for process, _, _ in running.values()])
                raise interruption.Interrupted(received.signal)
            for sentinel in ended:
                process, stored, core = running.pop(sentinel)
                process.join()
                free.append(core)
                failed += [stored] if process.exitcode else []
                outcome = "failed" if process.exitcode else "done"
                print(f"{outcome}: {title(stored)}", flush=True)
    if failed:
        logs = ", ".join(f"{stored.path}.log" for stored in failed)
        raise InputError(f"the training of {len(failed)} programs failed: see {logs}")
