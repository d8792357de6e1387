"""Train programs in their folders, for runs, sweeps and experiments alike."""

import contextlib
import pathlib
from collections.abc import Callable, Sequence
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
    run_folder,
    run_options,
    trackers,
)
from gasil_jax.host.driver import Outcome
from gasil_jax.host.interruption import Interrupted, Interruption
from gasil_jax.host.members import Members, make_members
from gasil_jax.host.periodic_checkpoints import CheckpointSchedule
from gasil_jax.host.progress import Progress, announced
from gasil_jax.host.run_options import Options
from gasil_jax.host.trackers import Tracker
from gasil_jax.sweeps.programs import Program


def prepare(options: Options, jobs: Sequence[Program]) -> Any:
    """Start the devices, check that everything fits, and return the environment.

    Nothing is compiled before this is done. The runs of each program are trained at
    once.

    Raises:
      InputError: if the programs do not fit the devices or the disk.
    """
    sizes = [(job.algorithm, len(job.runs)) for job in jobs]
    num_members = sum(count for _, count in sizes)
    devices.use_devices(options.settings, options.devices, num_members)
    env = run_options.make_env(options)
    schedule = run_options.evaluation_schedule(options)
    with announced(options.env, "starting the devices"):
        every = jax.devices()
    with command_line.input_checked():
        needs = [resources.need(env, algorithm) for algorithm, _ in sizes]
        for one, (algorithm, count) in zip(needs, sizes, strict=True):
            resources.check_memory(one, algorithm.config, count, every)
            if schedule is not None:
                resources.check_episodes(
                    env,
                    schedule.num_episodes,
                    count,
                    every,
                    option="evaluate_episodes",
                )
        resources.check_disk(
            [(one.state, count) for one, (_, count) in zip(needs, sizes, strict=True)],
            options.out or pathlib.Path("runs"),
            # One more, because the best checkpoint is kept too.
            options.keep_checkpoints + 1,
            written=sum(resources.size_of_checkpoints(job.path) for job in jobs),
        )
    run_options.note_if_untuned(options)
    run_options.note_options_without_effect(
        options, num_members, discrete=environments.is_discrete(env)
    )
    note_if_no_episode_ends(env, [algorithm for algorithm, _ in sizes])
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
    jobs: Sequence[Program],
    *,
    title: str,
    own_folder: bool = False,
    on_restored: Callable[[], None] = lambda: None,
) -> tuple[Members, Outcome]:
    """Train programs, one after the other; return the last one's members and outcome.

    Args:
      options: options of the run or sweep.
      env: what `prepare` returned.
      jobs: the programs, one or more.
      title: title of the progress display.
      own_folder: whether there is one program, in the folder of a run that is locked
        already. Otherwise each is locked, lists its runs and says when it has ended.
      on_restored: called for each program once its training can begin or continue
        without an error.

    Raises:
      InputError: if another process trains one of them.
      Interrupted: if a signal was received; a checkpoint was written first.
      OSError: if a folder can no longer be written. If only the last checkpoint of a
        run can't, its outcome has the error.
      ValueError: if a program to continue does not fit the options.
    """
    schedule = CheckpointSchedule(options.checkpoint_every, options.keep_checkpoints)
    num_members = sum(len(job.runs) for job in jobs)
    configs = [job.algorithm.config for job in jobs for _ in job.runs]
    total_steps = sum(x.num_iterations * x.batch_steps for x in configs)
    kind = "seeds" if num_members == options.seeds else "members"
    steps_before = 0
    with (
        Interruption() as interruption,
        Progress(title, total_steps, num_members, members=kind) as progress,
    ):
        for job in jobs:
            if interruption.signal is not None:
                raise Interrupted(interruption.signal)
            members = make_members(env, job.algorithm, job.seeds, job.hyperparameters)
            with contextlib.nullcontext() if own_folder else job.opened():
                with progress.aside("starting the trackers"):
                    job_trackers = _trackers(options, job, own_folder)
                outcome = driver.drive(
                    members,
                    job.path,
                    job.labels,
                    schedule=schedule,
                    evaluation_schedule=run_options.evaluation_schedule(options),
                    progress=progress,
                    interruption=interruption,
                    steps_before=steps_before,
                    trackers=job_trackers,
                    on_restored=on_restored,
                )
                if not own_folder:
                    if outcome.unsaved is not None:
                        # Its policies are nowhere else, so it is not finished.
                        raise outcome.unsaved
                    job.finish(outcome.measured)
            steps_before += members.env_steps(members.config.num_iterations)
    return members, outcome


def _trackers(options: Options, job: Program, own_folder: bool) -> list[Tracker]:
    """Return the trackers of a program, which has the name of its run or sweep."""
    *_, sweep, _, name = job.path.absolute().parts
    # What its members share is what the options say, but for traced numbers.
    shared = job.algorithm.replace(**options.algorithm.hyperparameters)
    config = run_options.description(options) | {"algorithm": shared}
    labels = zip(*job.labels.values(), strict=True)
    return trackers.make(
        options.log,
        job.path,
        run_name=name if own_folder else f"{sweep}-{name}",
        config=run_folder.flat(config),
        members={
            "-".join(map(str, label)): {**own, **dict(zip(job.labels, label))}
            for label, own in zip(labels, job.hyperparameters, strict=True)
        },
    )
