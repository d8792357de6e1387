"""A run's good trajectories as a Minari data set.

    python -m gasil_jax.export_minari RUN --name hopper/good-v0

Exact are the observations and actions (as the policy drew them; the environment
limits them to its range) of whole episodes, best first. The buffer keeps neither an
episode's rewards nor what followed its last action, so that is filled in: the last
step's reward is the episode's discounted return and the others are 0, the observation
after the last one is that one again, and every episode is called truncated. The last
episode of a full buffer may be cut short: it is left out unless it is as long as the
environment's limit. All this stands in the data set's description too.
"""

import dataclasses
import itertools
import pathlib
import shutil
import sys
import warnings
from collections.abc import Sequence
from typing import Annotated, Literal, NamedTuple

import jax
import numpy as np
import tyro

from gasil_jax import train
from gasil_jax.errors import InputError
from gasil_jax.good_trajectories import GoodTrajectories
from gasil_jax.host import command_line, run_folder
from gasil_jax.host.members import member
from gasil_jax.sweeps import saved_states

_DESCRIPTION = (
    "The good trajectories of {run}: whole episodes of {agent} on {env}, the best "
    "discounted returns first. Observations and actions are exact, actions as the "
    "policy drew them, before the environment limits them. Filled in: the reward of "
    "an episode's last step is its discounted return (gamma {gamma:g}) and the others "
    "are 0; the observation after the last action is the one before it; every episode "
    "is called truncated."
)


@dataclasses.dataclass(frozen=True)
class Options:
    """Write a run's good trajectories as a data set of Minari.

    Attributes:
      run: the run's folder, of a finished run or not.
      name: of the data set, NAMESPACE/DATASET-vVERSION; there must be none yet.
      seed: whose; default every seed's, in their order.
      point: of a sweep, its number in results.csv; default the best by mean.
      checkpoint: as it was then: last, or best by mean return in training.
    """

    run: Annotated[pathlib.Path, tyro.conf.Positional]
    name: str
    seed: int | None = None
    point: int | None = None
    checkpoint: Literal["last", "best"] = "last"


class Episode(NamedTuple):
    """One that is whole.

    Attributes:
      observation: float32 (steps, obs).
      action: float32 (steps, action).
      return_: discounted.
    """

    observation: np.ndarray
    action: np.ndarray
    return_: float


def episodes(
    buffer: GoodTrajectories, max_episode_steps: int, max_steps: float | None = None
) -> list[Episode]:
    """The buffer's whole episodes, best first.

    Args:
      buffer: of one run.
      max_episode_steps: one of so many steps is whole, wherever it is.
      max_steps: what `good_trajectories.insert` was limited to.
    """
    size = int(buffer.size)
    bounds = [*np.flatnonzero(np.asarray(buffer.time[:size]) == 0), size]
    observation, action = np.asarray(buffer.observation), np.asarray(buffer.action)
    found = [
        Episode(observation[start:end], action[start:end], float(buffer.return_[start]))
        for start, end in itertools.pairwise(bounds)
    ]
    most = buffer.capacity if max_steps is None else min(buffer.capacity, max_steps)
    if size >= int(most) and len(found[-1].action) < max_episode_steps:
        found.pop()
    return found


def check_name(name: str) -> None:
    """Refuse a name that is malformed or taken.

    Raises:
      InputError: that, or Minari is not installed.
    """
    try:
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
            f"name is {name!r}: it must be like hopper/good-v0, with a version"
        ) from None
    if get_dataset_path(name).exists():
        raise InputError(f"name is {name!r}, which exists: name a new data set")


def write(name: str, found: Sequence[Episode], **metadata: str) -> None:
    """Make a data set of Minari; see the module for what is filled in.

    Args:
      name: that `check_name` takes.
      found: one or more.
      **metadata: of `minari.create_dataset_from_buffers`.

    Raises:
      OSError: it can't be written; nothing is left of it.
    """
    import gymnasium
    import minari
    from minari.data_collector import EpisodeBuffer
    from minari.storage import get_dataset_path

    space = lambda x: gymnasium.spaces.Box(-np.inf, np.inf, x.shape[1:], np.float32)
    buffers = [
        EpisodeBuffer(
            id=index,
            observations=np.append(
                episode.observation, episode.observation[-1:], axis=0
            ),
            actions=episode.action,
            rewards=[0.0] * (len(episode.action) - 1) + [episode.return_],
            terminations=[False] * len(episode.action),
            truncations=[False] * (len(episode.action) - 1) + [True],
        )
        for index, episode in enumerate(found)
    ]
    try:
        with warnings.catch_warnings():
            # On an author and an environment, which it does without.
            warnings.simplefilter("ignore", UserWarning)
            minari.create_dataset_from_buffers(
                name,
                buffers,
                observation_space=space(found[0].observation),
                action_space=space(found[0].action),
                **metadata,
            )
    except BaseException:
        shutil.rmtree(get_dataset_path(name), ignore_errors=True)
        raise


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    return command_line.exit_status(lambda: _main(arguments))


def _main(arguments: Sequence[str] | None) -> None:
    options = command_line.parse(Options, arguments, "gasil_jax.export_minari")
    check_name(options.name)
    env, config, seeds, states = saved_states.load(
        options.run, options.checkpoint, options.point, options.seed
    )
    limit = train.max_episode_steps(env, config)
    most = states.hyperparameters.buffer_steps
    buffers = jax.device_get((states.good_trajectories, most))
    members = [member(buffers, place) for place in range(len(seeds))]
    found = [
        episode
        for buffer, max_steps in members
        for episode in episodes(buffer, limit, max_steps)
    ]
    if not found:
        raise InputError(f"run is {options.run}: no whole episode is in its buffer")
    described = run_folder.read(options.run)
    settings = dataclasses.asdict(described["settings"])
    description = _DESCRIPTION.format(
        run=options.run.resolve().name,
        agent=config.agent,
        env=f"{described['env']} {settings}",
        # A sweep's points may differ in it.
        gamma=float(states.hyperparameters.gamma[0]),
    )
    write(options.name, found, algorithm_name=config.agent, description=description)
    steps = sum(len(episode.action) for episode in found)
    print(f"{len(found)} episodes, {steps} steps in {options.name}")


if __name__ == "__main__":
    sys.exit(main())
