"""What doing nothing returns: zero actions on the tasks of the paper's own protocol.

Doing nothing until the time limit may return more than what an agent has learned. The
returns are in ``results/doing_nothing.csv``: the mean over episodes and its 95%
interval, of two standard errors. A delayed reward has the same sum over an episode.
"""

import csv
import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.curves import Figure
from experiments.search import TASKS
from experiments.store import RESULTS
from gasil_jax import evaluation, rollout
from gasil_jax.cli.parsing import check_minimum
from gasil_jax.host import output_file
from gasil_jax.host.environments import make_env

PATH = RESULTS / "doing_nothing.csv"


class Return(NamedTuple):
    """The mean return of episodes, and the ends of its interval."""

    mean: float
    low: float
    high: float


def measure(env: Any, key: jax.Array, episodes: int) -> Return:
    """Return what zero actions return in an environment: a pure function."""
    shape = (episodes, env.action_size)
    returns = evaluation.run_episodes(
        env,
        lambda observation, key: jnp.zeros(shape),
        key,
        num_episodes=episodes,
        num_steps=rollout.max_episode_steps(env),
    )["episode_return"]
    values = np.asarray(returns, np.float64)
    mean, error = float(values.mean()), float(values.std(ddof=1)) / np.sqrt(episodes)
    return Return(mean, mean - 2 * error, mean + 2 * error)


@functools.cache
def stored() -> Mapping[str, Return]:
    """Return what is in doing_nothing.csv, by task."""
    with PATH.open(newline="") as file:
        return {
            row["task"]: Return(*(float(row[x]) for x in Return._fields))
            for row in csv.DictReader(file)
        }


def of(figure: Figure, panel: str) -> Return | None:
    """Return what doing nothing returns in a panel, or None if it is not shown."""
    curve = next(iter(figure.panels[panel].values()))
    return stored()[curve.env] if figure.floor else None


@dataclasses.dataclass(frozen=True)
class Options:
    """Measure what zero actions return on the tasks, and write doing_nothing.csv.

    Attributes:
      episodes: episodes of each task.
    """

    episodes: int = 100


def run(options: Options) -> None:
    """Measure all tasks, and write doing_nothing.csv."""
    check_minimum(options, episodes=2)
    with output_file.atomic(PATH) as partial, partial.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["task", "episodes", *Return._fields])
        for env in TASKS[:5]:
            returned = measure(make_env(env), jax.random.key(0), options.episodes)
            numbers = [f"{x:.2f}" for x in returned]
            print(env, *numbers, flush=True)
            writer.writerow([env, options.episodes, *numbers])
