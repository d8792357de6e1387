"""Train the runs that are missing in a store, and add them to it.

Runs of the same environment and static settings are members of one compiled program. A
program's work folder is named by a hash of everything that it trains. The folder
therefore never holds other work, and stopped work continues from its checkpoints.
"""

import dataclasses
import hashlib
import json
import multiprocessing
import os
import pathlib
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from multiprocessing import connection
from typing import Any

import jax
import numpy as np

import gasil_jax
from experiments.store import Record, Run, Store
from gasil_jax.evaluation import evaluate
from gasil_jax.host import (
    command_line,
    driver,
    metrics_files,
    resources,
    run_folder,
    run_options,
)
from gasil_jax.host import devices as host_devices
from gasil_jax.host.environments import Settings
from gasil_jax.host.interruption import Interrupted, Interruption
from gasil_jax.host.members import make_members
from gasil_jax.host.progress import Progress
from gasil_jax.sweeps import shards

#: Equal parts of training in a record.
ROWS = 50
#: The columns of metrics.csv that identify the members of a program.
_LABELS = ("member", "seed")
_SECONDS_BETWEEN_LOOKS = 1.0
# New interpreters, because JAX does not survive a fork.
_CONTEXT = multiprocessing.get_context("spawn")


@dataclasses.dataclass(frozen=True)
class Setup:
    """The settings of training that do not decide a run's numbers.

    Attributes:
      runs: folder of the work folders.
      physics: physics engine of locomotion: mjx or mujoco.
      devices: number of host devices to shard members over; None for one per core.
      evaluate: episodes of the evaluation after training; 0 for no evaluation.
      source: commit of the checkout, and whether it was clean, before training.
    """

    runs: pathlib.Path
    physics: str = "mjx"
    devices: int | None = None
    evaluate: int = 0
    source: Mapping[str, Any] = dataclasses.field(default_factory=dict)


def source(commit: str | None = None) -> dict[str, Any]:
    """Return the checkout's commit, and whether its files are unchanged.

    Results are left out, because they change while experiments run.

    Args:
      commit: the commit to return if there is no repository.
    """

    def ask(*arguments: str) -> str | None:
        root = pathlib.Path(__file__).parent.parent
        command = ("git", "-C", str(root), *arguments)
        try:
            answer = subprocess.run(command, capture_output=True, text=True)
        except OSError:
            return None
        return answer.stdout.strip() if answer.returncode == 0 else None

    changed = ask("status", "--porcelain", "--", ".", ":!experiments/results")
    clean = None if changed is None else not changed
    return {"commit": ask("rev-parse", "--short=12", "HEAD") or commit, "clean": clean}


@dataclasses.dataclass(frozen=True)
class Program:
    """The runs that one compiled program trains.

    Attributes:
      runs: the members, which differ only in hyperparameters and seeds.
      physics: mjx or mujoco, whose states differ.
    """

    runs: tuple[Run, ...]
    physics: str

    def folder(self, runs: pathlib.Path) -> pathlib.Path:
        """Return the program's work folder."""
        text = " ".join([self.physics, *(run.key for run in self.runs)])
        return runs / hashlib.sha256(text.encode()).hexdigest()[:16]

    def __str__(self) -> str:
        run = self.runs[0]
        words = [f"{run.env} {run.config.agent}", f"{run.config.num_envs} environments"]
        words += [f"delayed {run.reward_delay}"] if run.reward_delay > 1 else []
        words += [] if run.config.stagger_episodes else ["in step"]
        one = len(self.runs) == 1
        return ", ".join(
            [*words, f"seed {run.seed}" if one else f"{len(self.runs)} runs"]
        )


def programs(runs: Iterable[Run], physics: str) -> list[Program]:
    """Divide runs into as few programs as possible."""
    groups: dict[Run, list[Run]] = {}
    for run in runs:
        # Only counts decide shapes, so only they need separate programs.
        counts = {x: getattr(run.config.hyperparameters, x) for x in shards.COUNTS}
        shared_values = gasil_jax.Hyperparameters(**counts)
        config = run.config.replace(hyperparameters=shared_values)
        shared = dataclasses.replace(run, config=config, seed=0)
        groups.setdefault(shared, []).append(run)
    ordered = lambda group: tuple(sorted(group, key=lambda run: run.key))
    return [Program(ordered(group), physics) for group in groups.values()]


def part_of(runs: Sequence[Run], part: shards.Shard) -> list[Run]:
    """Return every n-th run in the order of their keys, the same on each machine."""
    chosen = set(sorted(runs, key=lambda run: run.key)[part.number - 1 :: part.count])
    return [run for run in runs if run in chosen] if part.count > 1 else list(runs)


def train(program: Program, setup: Setup) -> dict[Run, Record]:
    """Train a program, or continue its training.

    Raises:
      InputError: it does not fit the memory, or another process works on it.
      Interrupted: by a signal; it has saved.
    """
    run, count = program.runs[0], len(program.runs)
    settings = Settings(
        run.reward_delay,
        run.obs_noise,
        physics=program.physics,
        integrator=run.integrator,
    )
    options = run_options.Options(
        env=run.env, settings=settings, config=run.config, devices=setup.devices
    )
    host_devices.use_devices(settings, setup.devices, count)
    env = run_options.make_env(options)
    with command_line.input_checked():
        resources.check_memory(env, run.config, count, jax.devices())
    seeds = [run.seed for run in program.runs]
    hyperparameters = [run.config.hyperparameters for run in program.runs]
    members = make_members(env, run.config, seeds, hyperparameters)
    folder = run_folder.create(program.folder(setup.runs), "")
    steps = run.config.num_iterations * run.config.batch_steps * count
    with (
        run_folder.lock(folder),
        Interruption() as interruption,
        Progress(str(program), steps) as progress,
    ):
        provenance = _provenance(folder, members.device_kind, program.physics, setup)
        try:
            outcome = driver.drive(
                members,
                folder,
                dict(zip(_LABELS, (range(count), seeds), strict=True)),
                schedule=driver.CheckpointSchedule(every=None, keep=1),
                progress=progress,
                interruption=interruption,
            )
        except Interrupted as interrupted:
            interrupted.add_note("go on with the same command")
            raise
        metrics = metrics_files.read_metrics(folder / "metrics.csv", _LABELS, count)
    final = np.full(count, np.nan)
    if setup.evaluate:
        final = _evaluate(env, program, outcome.states, setup.evaluate)
    of = lambda member: {name: values[member] for name, values in metrics.items()}
    return {
        run: record(of(member), float(final[member]), provenance)
        for member, run in enumerate(program.runs)
    }


def _provenance(
    folder: pathlib.Path, device: str, physics: str, setup: Setup
) -> dict[str, Any]:
    """With what a program is trained; all of it, if it went on with something else."""
    now = {"physics": physics, "device": device, "versions": metrics_files.versions()}
    now |= setup.source
    path = folder / "provenance.json"
    sessions = json.loads(path.read_text())["sessions"] if path.exists() else []
    if now not in sessions:
        sessions.append(now)
        metrics_files.write_json(path, {"sessions": sessions})
    every = lambda name: ", then ".join(
        dict.fromkeys(str(session[name]) for session in sessions if session.get(name))
    )
    # The worst of them: no, or unknown.
    order = (False, None, True)
    clean = min((session.get("clean") for session in sessions), key=order.index)
    commit = every("commit") or None
    return {**now, "device": every("device"), "commit": commit, "clean": clean}


def record(
    metrics: Mapping[str, np.ndarray], final: float, provenance: Mapping[str, Any]
) -> Record:
    """Return a run's record: means over parts of its metrics, (iterations,) each."""
    steps = metrics["env_steps"]
    parts = [x for x in np.array_split(np.arange(len(steps)), ROWS) if len(x)]

    def means(name: str) -> np.ndarray:
        values = metrics.get(name, np.full(len(steps), np.nan))
        seen = [values[part][np.isfinite(values[part])] for part in parts]
        return np.array([x.mean() if len(x) else np.nan for x in seen])

    return Record(
        env_steps=np.array([steps[part[-1]] for part in parts]),
        episode_return=means("episode_return"),
        episode_length=means("episode_length"),
        evaluation_return=means("evaluation_return"),
        final_evaluation=final,
        provenance=provenance,
    )


def _evaluate(env: Any, program: Program, states: Any, episodes: int) -> np.ndarray:
    """Return the mean return of each member's deterministic policy: (members,)."""
    config = program.runs[0].config

    def score(state: Any, seed: jax.Array) -> jax.Array:
        key = jax.random.fold_in(jax.random.key(seed), 1)
        scores = evaluate(env, config, state, key, num_episodes=episodes)
        return scores["episode_return"].mean()

    seeds = np.array([run.seed for run in program.runs], np.uint32)
    return np.asarray(jax.jit(jax.vmap(score))(states, seeds))


def train_missing(
    missing: Sequence[Run], store: Store, setup: Setup, processes: int | None = None
) -> None:
    """Train runs and add them to the store, each program as soon as it has ended.

    Args:
      missing: what to train.
      store: gets them.
      setup: with what.
      processes: so many single runs at a time, on the CPU, a process on cores of its
        own for each; None for one program after another that holds all runs alike.

    Raises:
      ChildProcessError: processes have failed; the other runs are done.
      Interrupted: by a signal, which the running processes were sent too.
    """
    if processes is None:
        for program in programs(missing, setup.physics):
            store.add(train(program, setup))
        return
    waiting = [Program((run,), setup.physics) for run in missing]
    total, ended, failed = len(waiting), 0, []
    free, running = list(range(processes)), dict[Any, tuple[Program, int, Any, float]]()
    log = lambda program: program.folder(setup.runs).with_suffix(".log")
    with Interruption() as interruption:
        try:
            while waiting or running:
                if interruption.signal is not None:
                    interrupted = Interrupted(interruption.signal)
                    interrupted.add_note("go on with the same command")
                    raise interrupted
                while free and waiting:
                    program, slot = waiting.pop(0), free.pop(0)
                    work = (program, store.folder, setup, (slot, processes))
                    child = _CONTEXT.Process(target=_work, args=(*work, log(program)))
                    child.start()
                    running[child.sentinel] = program, slot, child, time.monotonic()
                for sentinel in connection.wait(list(running), _SECONDS_BETWEEN_LOOKS):
                    program, slot, child, began = running.pop(sentinel)
                    child.join()
                    free.append(slot)
                    if child.exitcode != 0:
                        failed.append(program)
                        continue
                    ended += 1
                    seconds = time.monotonic() - began
                    print(
                        f"{program}: {seconds:.0f} s ({ended} of {total})", flush=True
                    )
        finally:
            for _, _, child, _ in running.values():
                child.terminate()
            for _, _, child, _ in running.values():
                child.join()
            store.refresh()
    if failed:
        logs = ", ".join(str(log(program)) for program in failed)
        raise ChildProcessError(
            f"{len(failed)} of {total} runs failed, see {logs}; the others are done, "
            "and the same command goes on"
        )


def _work(
    program: Program,
    store: pathlib.Path,
    setup: Setup,
    slot: tuple[int, int],
    log: pathlib.Path,
) -> None:
    """Run the work of a process, and exit with a status."""
    # In a session of its own Ctrl-C reaches it once, from the parent.
    os.setsid()
    if hasattr(os, "sched_setaffinity"):
        number, processes = slot
        cores = sorted(os.sched_getaffinity(0))
        # If there are fewer cores than processes, processes share cores.
        own = cores[number::processes] or [cores[number % len(cores)]]
        os.sched_setaffinity(0, own)
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as file:
        for stream in (sys.stdout, sys.stderr):
            os.dup2(file.fileno(), stream.fileno())
    jax.config.update("jax_platforms", "cpu")
    alone = dataclasses.replace(setup, devices=1)

    def work() -> None:
        Store(store).add(train(program, alone))

    sys.exit(command_line.exit_status(work))
