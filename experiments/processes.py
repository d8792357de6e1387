"""Trials on many processor cores: a process on cores of its own for each run.

A program that trains all seeds of a trial has one step of all of them wait for the
slowest core, and trials one after another leave most cores of a large machine idle.
"""

import multiprocessing
import os
import pathlib
import sys
import time
from collections.abc import Collection, Iterator, Sequence
from multiprocessing import connection
from typing import Any, NamedTuple

import jax

from experiments import trials
from experiments.trials import Trial
from gasil_jax import shards
from gasil_jax.command_line import InputError
from gasil_jax.config import Config
from gasil_jax.interruption import Interrupted, Interruption

_SECONDS_BETWEEN_LOOKS = 1.0
# A new interpreter: what a fork shares with its parent JAX does not survive.
_CONTEXT = multiprocessing.get_context("spawn")


class _Run(NamedTuple):
    """One seed of one point."""

    trial: Trial
    part: int
    parts: int

    @property
    def name(self) -> str:
        return f"{self.trial.name} {self.part}/{self.parts}"

    def log(self, runs: pathlib.Path) -> pathlib.Path:
        """Where it goes what the process prints."""
        return runs / f"{self.trial.name}.{self.part}-of-{self.parts}.log"


def _runs(trial: Trial, done: Collection[tuple[int, int]]) -> list[_Run]:
    """One for each member, in the order in which a sweep is cut, but for those done."""
    seeds = range(trial.first_seed, trial.first_seed + trial.seeds)
    programs = shards.programs(Config(agent=trial.agent), trial.points, seeds)
    members = [member for program in programs for member in program.members]
    return [
        _Run(trial, part, len(members))
        for part, member in enumerate(members, start=1)
        if member not in done
    ]


def train(
    todo: Sequence[tuple[Trial, Collection[tuple[int, int]]]],
    runs: pathlib.Path,
    processes: int,
    flags: Sequence[str] = (),
) -> Iterator[Trial]:
    """Train trials on the CPU, so many runs at a time; runs that have ended stay so.

    Args:
      todo: in this order; of each the (point, seed) that are known already.
      runs: folder of the experiment's runs; what a process prints goes there too, to
        PANEL/CURVE.K-of-N.log.
      processes: how many at once.
      flags: more of them, for the sweep's command line.

    Yields:
      The trial of each run, when it has ended well.

    Raises:
      ChildProcessError: runs have failed; the others are done.
      Interrupted: by a signal, which the running ones were sent too: they have saved.
    """
    waiting = [run for trial, done in todo for run in _runs(trial, done)]
    total, ended, failed = len(waiting), 0, []
    free = list(range(processes))
    running: dict[Any, tuple[_Run, int, Any, float]] = {}
    with Interruption() as interruption:
        try:
            while waiting or running:
                if interruption.signal is not None:
                    interrupted = Interrupted(interruption.signal)
                    interrupted.add_note("go on with the same command")
                    raise interrupted
                while free and waiting:
                    run, slot = waiting.pop(0), free.pop(0)
                    arguments = (run, runs, (slot, processes), tuple(flags))
                    child = _CONTEXT.Process(target=_work, args=arguments)
                    child.start()
                    running[child.sentinel] = (run, slot, child, time.monotonic())
                for sentinel in connection.wait(list(running), _SECONDS_BETWEEN_LOOKS):
                    run, slot, child, began = running.pop(sentinel)
                    child.join()
                    free.append(slot)
                    if child.exitcode != 0:
                        failed.append(run)
                        continue
                    ended += 1
                    seconds = time.monotonic() - began
                    print(f"{run.name}: {seconds:.0f} s ({ended} of {total})")
                    yield run.trial
        finally:
            for _, _, child, _ in running.values():
                child.terminate()
            for _, _, child, _ in running.values():
                child.join()
    if failed:
        logs = ", ".join(str(run.log(runs)) for run in failed)
        raise ChildProcessError(
            f"{len(failed)} of {total} runs failed, see {logs}; the others are done, "
            "and the same command goes on"
        )


def _work(
    run: _Run, runs: pathlib.Path, slot: tuple[int, int], flags: Sequence[str]
) -> None:
    """What a process does; exits with the status of training."""
    # In a session of its own Ctrl-C reaches it once, from the parent.
    os.setsid()
    if hasattr(os, "sched_setaffinity"):
        number, processes = slot
        cores = sorted(os.sched_getaffinity(0))
        # Where there are fewer cores than processes, some share one.
        own = cores[number::processes] or [cores[number % len(cores)]]
        os.sched_setaffinity(0, own)
    log = run.log(runs)
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as file:
        for stream in (sys.stdout, sys.stderr):
            os.dup2(file.fileno(), stream.fileno())
    jax.config.update("jax_platforms", "cpu")
    try:
        flags = (*flags, "--devices", "1")
        sys.exit(trials.train(run.trial, runs, run.part, run.parts, flags))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
