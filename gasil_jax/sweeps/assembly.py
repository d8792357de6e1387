"""Train programs in their folders, for runs, sweeps and shards alike.

A run is a sweep of one point, whose only program has the run's own folder.
"""

import contextlib
import dataclasses
import pathlib
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any

import jax

from gasil_jax import train as training
from gasil_jax.algorithms import Algorithm
from gasil_jax.host import (
    command_line,
    devices,
    driver,
    environments,
    resources,
    run_options,
    trackers,
)
from gasil_jax.host.interruption import Interrupted, Interruption
from gasil_jax.host.members import Members, make_members
from gasil_jax.host.periodic_checkpoints import CheckpointSchedule
from gasil_jax.host.progress import Progress, announced
from gasil_jax.host.run_options import (
    Options,
    described,
    evaluation_schedule,
    make_env,
)
from gasil_jax.sweeps.programs import Program, ProgramFolder


@dataclasses.dataclass(frozen=True)
class Job:
    """A program to train.

    Attributes:
      stored: the program with the folder of its metrics.csv and checkpoints.
      name: name of the program's run in trackers.
    """

    stored: ProgramFolder
    name: str

    @property
    def program(self) -> Program:
        """The program."""
        return self.stored.program

    @property
    def members(self) -> dict[str, dict[str, Any]]:
        """What each member has of its own, by its label, POINT-SEED or SEED."""
        names, numbers = self.stored.labels, self.program.hyperparameters
        labels = zip(*names.values(), strict=True)
        return {
            "-".join(map(str, label)): {**own, **dict(zip(names, label))}
            for label, own in zip(labels, numbers, strict=True)
        }


def prepare(
    options: Options, programs: Sequence[Program], folders: Sequence[pathlib.Path] = ()
) -> Any:
    """Start the devices, check that everything fits, and return the environment.

    Nothing is compiled before this is done.

    Args:
      options: options of the run or sweep.
      programs: the programs to train; the runs of each are trained at once.
      folders: their folders, where they have begun.

    Raises:
      InputError: if the programs do not fit the devices or the disk.
    """
    num_members = sum(len(program.runs) for program in programs)
    devices.use_devices(options.settings, options.devices, num_members)
    env = make_env(options)
    schedule = evaluation_schedule(options)
    with announced(options.env, "starting the devices"):
        every = jax.devices()
    with command_line.input_checked():
        for program in programs:
            count = len(program.runs)
            resources.check_memory(env, program.algorithm, count, every)
            if schedule is not None:
                resources.check_episodes(
                    env,
                    schedule.num_episodes,
                    count,
                    every,
                    option="evaluate_episodes",
                )
        resources.check_disk(
            env,
            [(program.algorithm, len(program.runs)) for program in programs],
            options.out or pathlib.Path("runs"),
            # One more, because the best checkpoint is kept too.
            options.keep_checkpoints + 1,
            written=sum(map(resources.size_of_checkpoints, folders)),
        )
    run_options.note_if_untuned(options)
    run_options.note_options_without_effect(
        options, num_members, discrete=environments.is_discrete(env)
    )
    note_if_no_episode_ends(env, [program.algorithm for program in programs])
    return env


def note_if_no_episode_ends(env: Any, algorithms: Sequence[Algorithm]) -> None:
    """Print a note if no episode can end within the steps of an environment."""
    for config in (algorithm.config for algorithm in algorithms):
        steps = config.num_iterations * config.num_steps
        limit = training.max_episode_steps(env)
        if steps < limit and not environments.ends_early(env):
            command_line.note(
                f"no episode can end, so no return is known: each of {config.num_envs} "
                f"environments takes {steps:,} steps, and an episode has {limit:,}: "
                "lower --num-envs or raise --total-steps"
            )
            return


def train(
    options: Options,
    env: Any,
    jobs: Sequence[Job],
    *,
    title: str,
    on_finished: Callable[[Job, Members, driver.Outcome], None],
    on_restored: Callable[[], None] = lambda: None,
    opened: Callable[[Job], AbstractContextManager[Any]] = contextlib.nullcontext,
) -> None:
    """Train programs, one after the other.

    Args:
      options: options of the run or sweep.
      env: one environment.
      jobs: the programs with their folders, in order.
      title: title of the progress display.
      on_finished: called when a program has been trained to its end.
      on_restored: called for each program once its training can begin or continue
        without an error.
      opened: opens a program's folder for the time of its training.

    Raises:
      Interrupted: if a signal was received; a checkpoint was written first.
      OSError: if a folder can no longer be written. If only a program's last checkpoint
        can't, its outcome has the error.
      ValueError: if a program to continue does not fit the options.
    """
    schedule = CheckpointSchedule(options.checkpoint_every, options.keep_checkpoints)
    num_members = sum(len(job.program.runs) for job in jobs)
    total_steps = options.algorithm.config.total_steps * num_members
    kind = "seeds" if num_members == options.seeds else "members"
    steps_before = 0
    with (
        Interruption() as interruption,
        Progress(title, total_steps, num_members, members=kind) as progress,
    ):
        for job in jobs:
            if interruption.signal is not None:
                raise Interrupted(interruption.signal)
            program, folder = job.program, job.stored.path
            with opened(job):
                with progress.aside("starting the trackers"):
                    job_trackers = trackers.make(
                        options.log,
                        folder,
                        run_name=job.name,
                        config=described(options, _shared(program, options)),
                        members=job.members,
                    )
                members = make_members(
                    env, program.algorithm, program.seeds, program.hyperparameters
                )
                outcome = driver.drive(
                    members,
                    folder,
                    job.stored.labels,
                    schedule=schedule,
                    evaluation_schedule=evaluation_schedule(options),
                    progress=progress,
                    interruption=interruption,
                    steps_before=steps_before,
                    trackers=job_trackers,
                    on_restored=on_restored,
                )
                on_finished(job, members, outcome)
            steps_before += program.env_steps


def _shared(program: Program, options: Options) -> Algorithm:
    """Return a program's algorithm with the traced numbers of the options."""
    return program.algorithm.replace(**options.algorithm.hyperparameters)


def train_in_folders(
    options: Options,
    env: Any,
    jobs: Sequence[Job],
    *,
    title: str,
    on_restored: Callable[[], None] = lambda: None,
) -> None:
    """Train programs as `train` does, each in a folder that says what is in it.

    Raises:
      InputError: if another process trains one of them.
    """

    def finish(job: Job, members: Members, outcome: driver.Outcome) -> None:
        if outcome.unsaved is not None:
            # Its policies are nowhere else, so it is not finished.
            raise outcome.unsaved
        job.stored.finish(
            env_steps=outcome.new_steps,
            compile_seconds=outcome.compile_seconds,
            train_seconds=outcome.train_seconds,
            evaluation_seconds=outcome.evaluation_seconds,
            device=members.device_kind,
            device_count=len(members.devices),
        )

    train(
        options,
        env,
        jobs,
        title=title,
        on_finished=finish,
        on_restored=on_restored,
        opened=lambda job: job.stored.opened(),
    )
