"""Train the runs that are missing in a store, and add them to it.

Runs with the same environment and static settings are members of one compiled program.
A program is trained in a scratch folder whose name is a hash of all its settings, so a
folder never mixes two programs. Interrupted training is only continued if
`Setup.resume` is set.
"""

import dataclasses
import functools
import hashlib
import itertools
import json
import math
import multiprocessing
import multiprocessing.connection
import os
import pathlib
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from experiments.search import FINALIST_SEEDS
from experiments.store import Record, Run, Store, run_of
from gasil_jax.algorithms import Algorithm
from gasil_jax.errors import InputError
from gasil_jax.host import metrics_files, run_folder, run_options
from gasil_jax.host.environments import Settings
from gasil_jax.host.interruption import Interrupted
from gasil_jax.sweeps import assembly, shards

#: Equal parts of training in a record, and evaluations during training.
ROWS, EVALUATIONS = 50, 10
#: Files and folders of the checkout that experiments write.
_WRITTEN = (
    *("experiments/results", "README.md", "gasil_jax/tuned_presets.json"),
    *("gasil_jax/zoo", "docs/zoo.md"),
)
#: The file of a scratch folder that lists the runs in training there.
_RUNS = "runs.json"
#: The columns of metrics.csv that identify the members of a program.
_LABELS = ("member", "seed")


@dataclasses.dataclass(frozen=True)
class Setup:
    """The settings of training that do not decide a run's numbers.

    Attributes:
      runs: scratch folder of the training in progress.
      resume: continue interrupted training in the scratch folder, which is otherwise
        refused. Runs that the results hold are never trained again, with or without it.
      physics: physics engine of locomotion: mjx or mujoco.
      devices: number of CPU devices to shard members over; default one per core. All
        visible GPUs are used in any case.
      evaluate_episodes: episodes of each of the ten evaluations during training; 0
        for no evaluations. Runs of a search are not evaluated.
      processes: number of programs that are trained at once, each by a process of its
        own on one core. Where each run has few environments this is the fastest way.
        With 1 the program's runs are sharded over `devices`.
      members: largest number of runs in a program; default no limit.
      commit: commit of the code, to be recorded if there is no repository.
    """

    runs: pathlib.Path = pathlib.Path("runs", "experiments")
    resume: bool = False
    physics: str = "mjx"
    devices: int | None = None
    evaluate_episodes: int = 10
    processes: int = 1
    members: int | None = None
    commit: str | None = None


@functools.cache
def source(commit: str | None) -> dict[str, Any]:
    """Return the checkout's commit, and whether its files are unchanged.

    Files that experiments write do not count as changed.

    Args:
      commit: the commit to return if there is no repository.
    """

    def git(*arguments: str) -> str | None:
        command = ("git", "-C", str(pathlib.Path(__file__).parent.parent), *arguments)
        try:
            answer = subprocess.run(command, capture_output=True, text=True)
        except OSError:
            return None
        return answer.stdout.strip() if answer.returncode == 0 else None

    written = [f":!{path}" for path in _WRITTEN]
    changed = git("status", "--porcelain", "--", ".", *written)
    clean = None if changed is None else not changed
    return {"commit": git("rev-parse", "--short=12", "HEAD") or commit, "clean": clean}


@dataclasses.dataclass(frozen=True)
class Program:
    """The runs that one compiled program trains.

    Attributes:
      runs: the members, which differ only in hyperparameters and seeds.
      setup: how they are trained.
    """

    runs: tuple[Run, ...]
    setup: Setup

    @property
    def evaluate_episodes(self) -> int:
        """The number of episodes of each evaluation."""
        return 0 if _is_of_search(self.runs[0]) else self.setup.evaluate_episodes

    @property
    def folder(self) -> pathlib.Path:
        """The program's scratch folder."""
        # Physics and evaluations are not in a run's key, but checkpoints and tables
        # depend on them.
        names = [self.setup.physics, str(self.evaluate_episodes)]
        text = " ".join([*names, *(run.key for run in self.runs)])
        return self.setup.runs / hashlib.sha256(text.encode()).hexdigest()[:16]

    def __str__(self) -> str:
        run, count = self.runs[0], len(self.runs)
        config = run.algorithm.config
        words = [f"{run.env} {run.algorithm.agent.name}"]
        words += [f"{config.num_envs} environments"]
        words += [f"delayed {run.reward_delay}"] if run.reward_delay > 1 else []
        words += [] if config.stagger_episodes else ["in step"]
        words += [f"seed {run.seed}" if count == 1 else f"{count} runs"]
        return ", ".join(words)


def _is_of_search(run: Run) -> bool:
    return run.seed in FINALIST_SEEDS


def programs(runs: Iterable[Run], setup: Setup) -> list[Program]:
    """Group runs into as few programs as possible, of at most `setup.members`."""
    groups: dict[tuple[Run, bool], list[Run]] = {}
    for run in runs:
        # Numbers that are traced may differ within a program.
        agent = type(run.algorithm.agent)
        models = tuple(type(model)() for model in run.algorithm.rewards)
        numbers = Algorithm(agent(), models).hyperparameters
        shared = dataclasses.replace(
            run, algorithm=run.algorithm.replace(**numbers), seed=0
        )
        groups.setdefault((shared, _is_of_search(run)), []).append(run)
    parts = []
    for group in groups.values():
        ordered = sorted(group, key=lambda run: run.key)
        count = math.ceil(len(ordered) / (setup.members or len(ordered)))
        cuts = [len(ordered) * part // count for part in range(count + 1)]
        parts += [tuple(ordered[a:b]) for a, b in itertools.pairwise(cuts)]
    return [Program(part, setup) for part in parts]


def select_by_key(runs: Iterable[Run], shard: shards.Shard) -> list[Run]:
    """Return the runs of a shard, the same on each machine.

    A run's shard depends on its key alone, not on which other runs are missing.
    """
    return [x for x in runs if int(x.key, 16) % shard.count == shard.number - 1]


def train(program: Program) -> dict[Run, Record]:
    """Train a program, or continue its training.

    Raises:
      InputError: if it does not fit into memory or on the disk, or if another process
        trains it.
      Interrupted: if a signal was received; a checkpoint was written first.
    """
    run, setup, folder = program.runs[0], program.setup, program.folder
    episodes = program.evaluate_episodes or None
    algorithm, total_steps = run.algorithm, run.algorithm.config.total_steps
    settings = Settings(
        reward_delay=run.reward_delay,
        obs_noise=run.obs_noise,
        physics=setup.physics,
        integrator=run.integrator,
        terminal_limits=run.terminal_limits,
    )
    options = run_options.Options(
        env=run.env,
        out=folder,
        keep_checkpoints=1,
        evaluate_every=episodes and math.ceil(total_steps / EVALUATIONS),
        evaluate_episodes=episodes,
        devices=setup.devices,
        settings=settings,
        **run_options.algorithm_options(algorithm),
    )
    seeds = tuple(run.seed for run in program.runs)
    numbers = tuple(run.algorithm.hyperparameters for run in program.runs)
    members = shards.Program(0, algorithm, tuple(enumerate(seeds)), numbers)
    labels = dict(zip(_LABELS, (range(len(seeds)), seeds), strict=True))
    env = assembly.prepare(options, [members], [members])
    read = lambda name: metrics_files.read_metrics(folder / name, _LABELS, len(seeds))
    with run_folder.lock(run_folder.create(folder)):
        runs = [{"experiment": x.experiment, "seed": x.seed} for x in program.runs]
        metrics_files.write_json(folder / _RUNS, {"runs": runs})
        provenance = _provenance(program)
        try:
            assembly.train(
                options,
                env,
                [assembly.Job(members, folder, labels, folder.name)],
                title=str(program),
                on_finished=lambda job, batch, outcome: None,
            )
        except Interrupted as interrupted:
            interrupted.add_note("continue with: the same command and --resume")
            raise
        metrics = read("metrics.csv")
        evaluations = read("evaluations.csv") if episodes else {}
    of = lambda table, member: {name: values[member] for name, values in table.items()}
    return {
        run: record(of(metrics, member), of(evaluations, member), provenance)
        for member, run in enumerate(program.runs)
    }


def _provenance(program: Program) -> dict[str, Any]:
    """Return how a program is trained, over all sessions of interrupted training."""
    setup, path = program.setup, program.folder / "provenance.json"
    devices = jax.devices()[: len(program.runs)]
    now = {
        "physics": setup.physics,
        "device": f"{len(devices)} x {devices[0].device_kind}",
        "versions": metrics_files.versions(),
        **source(setup.commit),
    }
    sessions = json.loads(path.read_text())["sessions"] if path.exists() else []
    if now not in sessions:
        sessions.append(now)
        metrics_files.write_json(path, {"sessions": sessions})
    every = lambda name: ", then ".join(
        dict.fromkeys(str(session[name]) for session in sessions if session[name])
    )
    # False if any session had a changed checkout; otherwise None if any is unknown.
    clean = min((x["clean"] for x in sessions), key=[False, None, True].index)
    commit = every("commit") or None
    return {**now, "device": every("device"), "commit": commit, "clean": clean}


def record(
    metrics: Mapping[str, np.ndarray],
    evaluations: Mapping[str, np.ndarray],
    provenance: Mapping[str, Any],
) -> Record:
    """Return a run's record.

    Args:
      metrics: columns of metrics.csv, (iterations,) each.
      evaluations: columns of evaluations.csv, (evaluations,) each; empty if there were
        none.
      provenance: how the run was trained, see `Record`.
    """
    steps = metrics["env_steps"]
    parts = [x for x in np.array_split(np.arange(len(steps)), ROWS) if len(x)]

    def means(name: str) -> np.ndarray:
        finite = [metrics[name][part] for part in parts]
        finite = [values[np.isfinite(values)] for values in finite]
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


def begun(missing: Iterable[Run], setup: Setup) -> list[Program]:
    """Return the programs in the scratch folder that train any of the missing runs.

    They may also have runs that have been stored since.

    Raises:
      InputError: if a folder's list of runs can't be read.
    """
    requested = frozenset(missing)
    return [
        program
        for path in sorted(setup.runs.glob(f"*/{_RUNS}"))
        # A program with another physics or evaluations has another folder.
        if (program := _listed(path, setup)).folder == path.parent
        and not requested.isdisjoint(program.runs)
    ]


def _listed(path: pathlib.Path, setup: Setup) -> Program:
    """Return the program of the runs that a file lists."""
    try:
        listed = json.loads(path.read_text())["runs"]
        return Program(tuple(run_of(**fields) for fields in listed), setup)
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} is not a list of runs: {error}") from None


def _requested(missing: Sequence[Run], setup: Setup) -> list[Program]:
    """Return the programs that train the missing runs, those in training first.

    Raises:
      InputError: if the scratch folder holds training of these runs and `Setup.resume`
        is not set.
    """
    unfinished = begun(missing, setup)
    continued = {run for program in unfinished for run in program.runs}
    others = [run for run in missing if run not in continued]
    requested = [*unfinished, *programs(others, setup)]
    used = [x.folder.name for x in requested if any(x.folder.glob("[!.]*"))]
    if used and not setup.resume:
        raise InputError(
            f"runs is {setup.runs}, which holds training of these runs in "
            f"{', '.join(used)}: continue it with --resume, or name another folder"
        )
    return requested


def _train_on_core(program: Program, store: pathlib.Path, core: int) -> None:
    """Train a program on one core; what this process prints goes to a log file."""
    os.sched_setaffinity(0, {core})
    with open(f"{program.folder}.log", "a") as log:
        for stream in (sys.stdout, sys.stderr):
            os.dup2(log.fileno(), stream.fileno())
        Store(store).add(train(program))


def train_in_processes(
    missing: Callable[[], Sequence[Run]], store: Store, setup: Setup
) -> None:
    """Train runs in `setup.processes` processes of one core each; see `train_missing`.

    Args:
      missing: returns the runs that are not stored, the most important first. It is
        called again after each program, because the result of a search decides which
        runs are needed.
      store: the store that the runs are added to.
      setup: how they are trained.

    Raises:
      InputError: if there are more processes than cores, as `train_missing`, or if the
        training of a program failed; the others are trained first.
    """
    cores = sorted(os.sched_getaffinity(0))
    if setup.processes > len(cores):
        raise InputError(
            f"processes is {setup.processes}: it must be at most the number of cores, "
            f"{len(cores)}"
        )
    setup.runs.mkdir(parents=True, exist_ok=True)
    spawn = multiprocessing.get_context("spawn")
    free = cores[: setup.processes]
    failed: list[Program] = []
    running: dict[Any, tuple[Any, Program, int]] = {}
    while True:
        begun_here = [*failed, *(program for _, program, _ in running.values())]
        not_waiting = {run for program in begun_here for run in program.runs}
        waiting = [run for run in missing() if run not in not_waiting]
        for program in _requested(waiting, setup)[: len(free)]:
            core = free.pop()
            process = spawn.Process(
                target=_train_on_core, args=(program, store.folder, core)
            )
            process.start()
            running[process.sentinel] = process, program, core
        if not running:
            break
        for sentinel in multiprocessing.connection.wait(list(running)):
            process, program, core = running.pop(sentinel)
            process.join()
            free.append(core)
            failed += [program] if process.exitcode else []
            print(f"{'failed' if process.exitcode else 'done'}: {program}", flush=True)
    if failed:
        logs = ", ".join(f"{program.folder}.log" for program in failed)
        raise InputError(f"the training of {len(failed)} programs failed: see {logs}")


def train_missing(missing: Sequence[Run], store: Store, setup: Setup) -> None:
    """Train runs and add them to the store, each program as soon as it has ended.

    Raises:
      InputError: if the scratch folder holds training of these runs and `Setup.resume`
        is not set.
      Interrupted: if a signal was received; a checkpoint was written first.
    """
    for program in _requested(missing, setup):
        # Another process may have added them since.
        if Store(store.folder).missing(program.runs):
            store.add(train(program))
