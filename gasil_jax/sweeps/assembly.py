"""Train programs in their folders, for runs, sweeps and shards alike.

A run is a sweep of one point, whose only program has the run's own folder.
"""

import dataclasses
import pathlib
from collections.abc import Callable, Mapping, Sequence
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
from gasil_jax.sweeps.shards import Program


@dataclasses.dataclass(frozen=True)
class Job:
    """A program and the folder that it is trained in.

    Attributes:
      program: the program, with its algorithm and members.
      folder: folder of its metrics.csv and checkpoints, created if it is missing.
      labels: columns that identify the members in the tables, (members,) each.
      name: name of the program's run in trackers.
      finished: whether it is trained to its end, so that it is skipped.
    """

    program: Program
    folder: pathlib.Path
    labels: Mapping[str, Sequence[Any]]
    name: str
    finished: bool = False

    @property
    def env_steps(self) -> int:
        """The number of environment steps over all members."""
        config = self.program.algorithm.config
        return config.num_iterations * config.batch_steps * len(self.program.members)


def prepare(
    options: Options, programs: Sequence[Program], unfinished: Sequence[Program]
) -> Any:
    """Start the devices, check that everything fits, and return the environment.

    Nothing is compiled before this is done.

    Args:
      options: options of the run or sweep.
      programs: the programs; the members of each are trained at once.
      unfinished: the programs whose checkpoints are still to be written.

    Raises:
      InputError: if the programs do not fit the devices or the disk.
    """
    num_members = sum(len(program.members) for program in programs)
    devices.use_devices(options.settings, options.devices, num_members)
    env = make_env(options)
    schedule = evaluation_schedule(options)
    with announced(options.env, "starting the devices"):
        every = jax.devices()
    out = options.out
    # A run's checkpoints are in its own folder, a sweep's in those of its programs.
    folders = [out, *(program.folder(out) for program in unfinished)] if out else []
    with command_line.input_checked():
        for program in programs:
            count = len(program.members)
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
            [(program.algorithm, len(program.members)) for program in unfinished],
            out or pathlib.Path("runs"),
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
) -> None:
    """Train the unfinished jobs, one after the other.

    Args:
      options: options of the run or sweep.
      env: one environment.
      jobs: the jobs in order, including finished ones.
      title: title of the progress display.
      on_finished: called when a job has been trained to its end.
      on_restored: called for each job once its training can begin or continue without
        an error.

    Raises:
      Interrupted: if a signal was received; a checkpoint was written first.
      OSError: if a folder can no longer be written. If only a job's last checkpoint
        can't, its outcome has the error.
      ValueError: if a job to continue does not fit the options.
    """
    schedule = CheckpointSchedule(options.checkpoint_every, options.keep_checkpoints)
    num_members = sum(len(job.program.members) for job in jobs)
    total_steps = options.algorithm.config.total_steps * num_members
    kind = "seeds" if num_members == options.seeds else "members"
    steps_before = 0
    with (
        Interruption() as interruption,
        Progress(title, total_steps, num_members, members=kind) as progress,
    ):
        for job in jobs:
            if not job.finished:
                if interruption.signal is not None:
                    raise Interrupted(interruption.signal)
                job.folder.mkdir(parents=True, exist_ok=True)
                with progress.aside("starting the trackers"):
                    job_trackers = trackers.make(
                        options.log,
                        job.folder,
                        run_name=job.name,
                        # The points of a program may change settings of the algorithm.
                        config=described(options, job.program.algorithm),
                    )
                members = make_members(
                    env,
                    job.program.algorithm,
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
                    trackers=job_trackers,
                    on_restored=on_restored,
                )
                on_finished(job, members, outcome)
            steps_before += job.env_steps
