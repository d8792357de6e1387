"""Train programs in their folders, for the command line, `fit` and experiments."""

import contextlib
import pathlib
from collections.abc import Sequence
from typing import Any

import jax

from gasil_envs import user_code
from gasil_jax import checks, rollout, train
from gasil_jax.algorithms import Algorithm
from gasil_jax.errors import InputError
from gasil_jax.host import devices, driver, environments, resources, trackers
from gasil_jax.host.driver import Callback, Outcome
from gasil_jax.host.interruption import Interrupted, Interruption
from gasil_jax.host.members import make_members
from gasil_jax.host.output_file import note
from gasil_jax.host.programs import Program
from gasil_jax.host.progress import Progress, announced
from gasil_jax.host.sweep import Recording, Sweep
from gasil_jax.host.trackers import Tracker


def make_env(sweep: Sweep) -> Any:
    """Build the environment of a sweep; raise `ValueError` if it can't be."""
    with announced(sweep.env, "building the environment"):
        return environments.make_env(sweep.env, **vars(sweep.settings))


def prepare(
    sweep: Sweep,
    programs: Sequence[Program],
    *,
    num_devices: int | None = None,
) -> Any:
    """Start the devices, check that all works and fits, and return the environment."""
    num_members = sum(len(each.runs) for each in programs)
    devices.use_devices(sweep.settings, num_devices, num_members)
    env = make_env(sweep)
    every = sweep.recording.video_every
    if every is not None and not environments.can_be_drawn(env):
        raise InputError(
            f"video_every is {every}: {sweep.env} must have a function "
            "draw(state, size), because nothing else can draw it"
        )
    with announced(sweep.env, "starting the devices"):
        visible = jax.devices()
    algorithms = {x.algorithm.agent.name: x.algorithm for x in programs}
    for each in algorithms.values():
        _check(env, each)
    with announced(sweep.env, "tracing the first state"):
        resources.check(env, programs, sweep.recording, visible)
    _note_if_no_episode_ends(env, [each.algorithm for each in programs])
    return env


def _check(env: Any, algorithm: Algorithm) -> None:
    """Check that an algorithm can run in an environment; trace what is the user's."""

    def begin() -> Any:
        state = train.first_state(env, algorithm, jax.random.key(0))
        return train.train_step(env, algorithm, state)

    checks.check(env, algorithm)
    own = [f"rewards {model.name!r}" for model in algorithm.own_models]
    if ":" in algorithm.agent.name:
        own.insert(0, f"agent {algorithm.agent.name!r}")
    if own:
        what, package = " and ".join(own), pathlib.Path(train.__file__).parent
        with user_code.refused(f"{what} can't be traced", package):
            with announced(what, "tracing its functions"):
                jax.eval_shape(begin)


def _note_if_no_episode_ends(env: Any, every: Sequence[Algorithm]) -> None:
    """Print a note if no episode can end within the steps of an environment."""
    for config in (algorithm.config for algorithm in every):
        steps = config.num_iterations * config.num_steps
        limit = rollout.max_episode_steps(env)
        if steps < limit and not environments.ends_early(env):
            note(
                f"no episode can end, so no return is known: each of {config.num_envs} "
                f"environments takes {steps:,} steps, and an episode has {limit:,}: "
                "lower --num-envs or raise --total-steps"
            )
            return


def train_programs(
    env: Any,
    programs: Sequence[Program],
    recording: Recording,
    *,
    title: str,
    interruption: Interruption,
    callback: Callback | None = None,
    shown: bool = True,
) -> list[Outcome]:
    """Train programs, one after the other, in their folders; return their outcomes."""
    if not programs:
        return []
    num_members = sum(len(each.runs) for each in programs)
    configs = [each.algorithm.config for each in programs for _ in each.runs]
    total_steps = sum(x.num_iterations * x.batch_steps for x in configs)
    outcomes: list[Outcome] = []
    steps_before = 0
    points = {run.experiment for each in programs for run in each.runs}
    called = "seeds" if len(points) == 1 else "runs"
    progress = Progress(title, total_steps, num_members, members=called, shown=shown)
    for each in programs:
        if interruption.signal is not None:
            raise Interrupted(interruption.signal)
        members = make_members(env, each.algorithm, each.seeds, each.hyperparameters)
        with each.opened(), contextlib.closing(progress):
            with progress.aside("starting the trackers"):
                own = _trackers(recording.log, each)
            outcome = driver.drive(
                members,
                each.path,
                each.labels,
                recording=recording,
                progress=progress,
                interruption=interruption,
                steps_before=steps_before,
                trackers=own,
                callback=callback,
            )
            if outcome.unsaved is not None and len(programs) > 1:
                raise outcome.unsaved
            if outcome.training["env_steps"] or each.training is None:
                each.finish(outcome.training)
        outcomes.append(outcome)
        steps_before += members.env_steps(members.config.num_iterations)
    return outcomes


def _trackers(names: Sequence[str], program: Program) -> list[Tracker]:
    """Return the trackers of a program, which has the name of its run or sweep."""
    if not names:
        return []
    run = program.runs[0]
    labels = map("-".join, zip(*(map(str, x) for x in program.labels.values())))
    return trackers.make(
        names,
        program.path,
        run_name=program.path.absolute().parent.parent.name,
        config={"env": run.env, **vars(run.settings), **run.algorithm.settings},
        members={
            label: {**own, "seed": seed}
            for label, own, seed in zip(
                labels, program.hyperparameters, program.seeds, strict=True
            )
        },
    )
