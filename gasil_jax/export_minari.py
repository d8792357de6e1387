"""Export a run's good trajectories as a Minari data set.

    python -m gasil_jax.export_minari RUN --name hopper/good-v0

The data set holds complete episodes, best first. Observations and actions are exact;
actions are as the policy drew them, before the environment limits them to its range;
discrete ones are numbers. Minari can recover the environment of the package's tasks.
The buffer does not hold an episode's rewards or its final observation, so these are
filled in: the last step's reward is the episode's return, discounted as the buffer
ranks it, and the others are 0; the final observation repeats the one before it; and
every episode is marked as truncated. The last episode of a full buffer may be cut. It
is left out unless it has the environment's full length. The data set's description says
the same.
"""

import dataclasses
import importlib
import itertools
import pathlib
import shutil
import sys
import warnings
from collections.abc import Sequence
from typing import Annotated, Any, Literal, NamedTuple

import jax
import numpy as np
import tyro

from gasil_envs import registry
from gasil_jax import train
from gasil_jax.buffer import GoodTrajectories
from gasil_jax.errors import InputError
from gasil_jax.host import command_line, run_folder
from gasil_jax.host.members import member
from gasil_jax.sweeps import saved_states

_DESCRIPTION = (
    "The good trajectories of {run}: whole episodes of {agent} on {env}, seed by seed, "
    "the best returns first. Observations and actions are exact, actions as the "
    "policy drew them, before the environment limits them. Filled in: the reward of "
    "an episode's last step is its return, {discounted}, and the others are 0; "
    "the observation after the last action is the one before it; every episode "
    "is called truncated."
)


@dataclasses.dataclass(frozen=True)
class Options:
    """Write a run's good trajectories as a Minari data set.

    Attributes:
      run: folder of the run or sweep, which need not be finished.
      name: name of the new data set, NAMESPACE/DATASET-vVERSION.
      seed: export only this seed's episodes; default all seeds', in their order.
      point: number of a sweep's point in results.csv; default the one with the
        highest mean final return, of those whose seeds all stayed finite.
      checkpoint: checkpoint of the buffer: last, or best, which has the best
        evaluation or, without evaluations, the best mean return in training.
    """

    run: Annotated[pathlib.Path, tyro.conf.Positional]
    name: str
    seed: int | None = None
    point: int | None = None
    checkpoint: Literal["last", "best"] = "last"


class Episode(NamedTuple):
    """A complete episode.

    Attributes:
      observation: float32 (steps, obs).
      action: float32 (steps, action).
      return_: the return that the buffer ranks it by.
    """

    observation: np.ndarray
    action: np.ndarray
    return_: float


def episodes(buffer: GoodTrajectories, max_episode_steps: int) -> list[Episode]:
    """Return the buffer's complete episodes, best first.

    Args:
      buffer: the buffer of one run.
      max_episode_steps: the step limit; an episode of this length can't have been cut.
    """
    size = int(buffer.size)
    bounds = [*np.flatnonzero(np.asarray(buffer.time[:size]) == 0), size]
    observation, action = np.asarray(buffer.observation), np.asarray(buffer.action)
    complete = [
        Episode(observation[start:end], action[start:end], float(buffer.return_[start]))
        for start, end in itertools.pairwise(bounds)
    ]
    if size >= buffer.capacity and len(complete[-1].action) < max_episode_steps:
        complete.pop()
    return complete


def check_name(name: str) -> None:
    """Check that a data set can be created under a name.

    Raises:
      InputError: if the name is malformed or taken, or if Minari is not installed.
    """
    try:
        importlib.import_module("h5py")  # Minari needs it to write a data set.
        from minari.dataset.minari_dataset import parse_dataset_id
        from minari.storage import get_dataset_path
    except ImportError:
        raise InputError(
            'the package minari is missing (pip install "gasil_jax[minari]")'
        ) from None
    try:
        parse_dataset_id(name)
    except (ValueError, TypeError):
        raise InputError(
            f"name is {name!r}: it must be like hopper/good-v0, with a version and "
            "at least two characters before a slash"
        ) from None
    if get_dataset_path(name).exists():
        raise InputError(f"name is {name!r}, which exists: name a new data set")


def write(
    name: str,
    complete: Sequence[Episode],
    *,
    num_actions: int | None = None,
    **metadata: Any,
) -> None:
    """Create a Minari data set; the module's docstring says what is filled in.

    Args:
      name: a name that `check_name` accepts.
      complete: one or more complete episodes.
      num_actions: number of discrete actions, which are then numbers in the data set;
        None if actions are vectors.
      **metadata: further arguments of `minari.create_dataset_from_buffers`.

    Raises:
      OSError: if it can't be written; nothing is left of it.
    """
    import gymnasium
    import minari
    from minari.data_collector import EpisodeBuffer
    from minari.storage import get_dataset_path

    def space(x: np.ndarray) -> Any:
        return gymnasium.spaces.Box(-np.inf, np.inf, x.shape[1:], np.float32)

    def actions(recorded: np.ndarray) -> np.ndarray:
        return recorded if num_actions is None else recorded.argmax(axis=-1)

    buffers = [
        EpisodeBuffer(
            id=index,
            observations=np.append(
                episode.observation, episode.observation[-1:], axis=0
            ),
            actions=actions(episode.action),
            rewards=[0.0] * (len(episode.action) - 1) + [episode.return_],
            terminations=[False] * len(episode.action),
            truncations=[False] * (len(episode.action) - 1) + [True],
        )
        for index, episode in enumerate(complete)
    ]
    # Another export may have taken the name since.
    check_name(name)
    try:
        with warnings.catch_warnings():
            # Minari warns that the author and the environment are missing.
            warnings.simplefilter("ignore", UserWarning)
            minari.create_dataset_from_buffers(
                name,
                buffers,
                observation_space=space(complete[0].observation),
                action_space=(
                    space(complete[0].action)
                    if num_actions is None
                    else gymnasium.spaces.Discrete(num_actions)
                ),
                **metadata,
            )
    except BaseException:
        shutil.rmtree(get_dataset_path(name), ignore_errors=True)
        raise


@command_line.reports_errors
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    options = command_line.parse(Options, arguments, "gasil_jax.export_minari")
    check_name(options.name)
    env, algorithm, seeds, states = saved_states.load(
        options.run, options.checkpoint, options.point, seed=options.seed
    )
    agent = algorithm.agent
    buffers = jax.device_get(agent.good_trajectories(states.agent))
    if not isinstance(buffers, GoodTrajectories):
        raise InputError(
            f"run is {options.run}, of agent {agent.name!r}: it has no buffer of good "
            "trajectories"
        )
    limit = train.max_episode_steps(env)
    complete = [
        episode
        for index in range(len(seeds))
        for episode in episodes(member(buffers, index), limit)
    ]
    if not complete:
        raise InputError(f"run is {options.run}: no whole episode is in its buffer")
    described = run_folder.read(options.run)
    settings = dataclasses.asdict(described["settings"])
    discounted = "not discounted"
    if getattr(agent, "buffer_discounts", True):
        # The points of a sweep may have different gammas.
        discounted = (
            f"discounted by {float(states.hyperparameters['gamma'][0]):g} a step"
        )
    description = _DESCRIPTION.format(
        run=options.run.resolve().name,
        agent=agent.name,
        env=f"{described['env']} {settings}",
        discounted=discounted,
    )
    spec = None
    if described["env"] in registry.names():
        from gasil_envs.gymnasium_adapter import gymnasium

        spec = gymnasium.spec(f"gasil_envs/{described['env']}")
        spec = dataclasses.replace(spec, kwargs={**spec.kwargs, **settings})
    write(
        options.name,
        complete,
        env=spec,
        num_actions=getattr(env, "num_actions", None),
        algorithm_name=agent.name,
        description=description,
    )
    steps = sum(len(episode.action) for episode in complete)
    print(f"{len(complete)} episodes, {steps} steps in {options.name}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
