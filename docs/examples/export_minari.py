"""Write a run's good trajectories as a Minari data set.

    python docs/examples/export_minari.py runs/hopper hopper/good-v0

Observations and actions are exact. What the buffer lacks is filled in: the last reward
of an episode is its return, as the buffer ranks it, and the others are 0; the
observation after the last action is the one before it; all are "truncated".
"""

import argparse
import itertools
import pathlib

import jax
import minari
import numpy as np
from gymnasium.spaces import Box, Discrete
from minari.data_collector import EpisodeBuffer

from gasil_jax import rollout
from gasil_jax.host import saved


def whole_episodes(buffer, limit):
    """Yield observations, actions and the return of episodes that are not cut."""
    starts = np.flatnonzero(buffer.time[: buffer.size] == 0)
    for start, end in itertools.pairwise([*starts, int(buffer.size)]):
        if end < buffer.capacity or end - start == limit:
            part = slice(start, end)
            yield buffer.observation[part], buffer.action[part], buffer.return_[start]


def main() -> None:
    """Write the data set, the best episode of each seed first."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=pathlib.Path)
    parser.add_argument("name", help="NAMESPACE/DATASET-vVERSION")
    options = parser.parse_args()

    env, _, seeds, states = saved.load(options.run)
    every = jax.device_get(states.agent.buffer)
    num_actions, episodes = getattr(env, "num_actions", None), []
    for i in range(len(seeds)):
        buffer = jax.tree.map(lambda x, i=i: x[i], every)
        for seen, done, total in whole_episodes(buffer, rollout.max_episode_steps(env)):
            last = np.arange(len(seen)) == len(seen) - 1
            actions = done if num_actions is None else done.argmax(axis=-1)
            steps = {"observations": np.append(seen, seen[-1:], 0), "actions": actions}
            steps |= {"terminations": last & False, "truncations": last}
            episodes.append(EpisodeBuffer(rewards=total * last, **steps))
    spaces = {"observation_space": Box(-np.inf, np.inf, (env.observation_size,))}
    spaces["action_space"] = Discrete(num_actions or 1)
    if num_actions is None:
        spaces["action_space"] = Box(-np.inf, np.inf, (env.action_size,))
    minari.create_dataset_from_buffers(options.name, episodes, **spaces)
    print(f"{len(episodes)} episodes in {options.name}")


if __name__ == "__main__":
    main()
