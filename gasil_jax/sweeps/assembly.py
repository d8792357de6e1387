"""Trains programs into folders: what a run, a sweep and a shard have in common.

A run is a sweep of one point, whose only program works in the run's own folder.
"""

import dataclasses
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax

from gasil_jax.host import (
    command_line,
    devices,
    driver,
    resources,
    run_folder,
    trackers,
)
from gasil_jax.host.interruption import Interruption
from gasil_jax.host.members import Batch, make_batch
from gasil_jax.host.progress import Progress, announced
from gasil_jax.host.run_options import Options, evaluation_schedule, make_env
from gasil_jax.sweeps.shards import Program


@dataclasses.dataclass(frozen=True)
class Job:
    """A program and the folder that it trains in.

    Attributes:
      program: its configuration and members.
      folder: of its metrics.csv and checkpoints; made where it is missing.
      labels: what the tables call the members, (members,) each.
      finished: whether it has been trained to its end already.
    """

    program: Program
    folder: pathlib.Path
    labels: Mapping[str, Sequence[Any]]
    finished: bool = False

    @property
    def env_steps(self) -> int:
        """Environment steps over all members."""
        config = self.program.config
        return config.num_iterations * config.batch_steps * len(self.program.members)


def prepare(
    options: Options, programs: Sequence[Program], unfinished: Sequence[Program]
) -> Any:
    """Start the devices, build the environment and check that all fits; returns it.

    Nothing compiles before this is done.

    Args:
      options: of the run or sweep.
      programs: with the members that are trained at once.
      unfinished: those whose checkpoints are still to be written.

    Raises:
      InputError: they don't fit the devices or the disk.
    """
    devices.use_devices(
        options.settings,
        options.devices,
        sum(len(program.members) for program in programs),
    )
    env = make_env(options)
    schedule = evaluation_schedule(options)
    with announced(options.env, "starting the devices"):
        every = jax.devices()
    with command_line.input_checked():
        for program in programs:
            count = len(program.members)
            resources.check_memory(env, program.config, count, every)
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
            [(program.config, len(program.members)) for program in unfinished],
            options.out or pathlib.Path("runs"),
            # The best one too.
            options.keep_checkpoints + 1,
        )
    return env


def train(
    options: Options,
    env: Any,
    jobs: Sequence[Job],
    *,
    title: str,
    on_finished: Callable[[Job, Batch, driver.Outcome], None],
) -> None:
    """Train jobs one after the other; those that are finished are left as they are.

    Args:
      options: of the run or sweep.
      env: one environment.
      jobs: in this order.
      title: of the progress display.
      on_finished: called when a job has been trained to its end.

    Raises:
      Interrupted: by a signal, after a checkpoint.
      OSError: a folder can't be written any more.
      ValueError: what is there to go on with does not fit.
    """
    schedule = driver.CheckpointSchedule(
        options.checkpoint_every, options.keep_checkpoints
    )
    steps_before = 0
    with (
        Interruption() as interruption,
        Progress(title, sum(job.env_steps for job in jobs)) as progress,
    ):
        for job in jobs:
            if not job.finished:
                job.folder.mkdir(parents=True, exist_ok=True)
                with progress.aside("starting the trackers"):
                    described = run_folder.flat(vars(options))
                    following = trackers.make(options.log, job.folder, described)
                members = make_batch(
                    env,
                    job.program.config,
                    [seed for _, seed in job.program.members],
                    job.program.hyperparameters,
                )
                outcome = driver.drive(
                    members,
                    job.folder,
                    job.labels,
                    schedule=schedule,
                    evaluation_schedule=evaluation_schedule(options),
                    progress=progress,
                    interruption=interruption,
                    steps_before=steps_before,
                    trackers=following,
                )
                on_finished(job, members, outcome)
            steps_before += job.env_steps
