"""Evaluate the policies of all members at regular intervals during training."""

import time
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from gasil_jax.evaluation import evaluate
from gasil_jax.host.members import Interval, Members
from gasil_jax.host.tables import TableWriter
from gasil_jax.host.trackers import Tracker
from gasil_jax.train import TrainState

# Far from the usual seed numbers, because training takes its keys from those.
_ROOT = 2**32 - 1


def evaluation_key(seed: jax.Array | int, iteration: jax.Array | int) -> jax.Array:
    """Return the key of a seed's evaluation after `iteration` iterations."""
    return jax.random.fold_in(
        jax.random.fold_in(jax.random.key(_ROOT), seed), iteration
    )


class Evaluation:
    """Evaluates all members with one compiled program, sharded as training is."""

    #: Columns of evaluations.csv after those that identify the members.
    COLUMNS = ("env_steps", "mean", "min", "max", "length")

    def __init__(
        self,
        members: Members,
        *,
        every: int,
        num_episodes: int,
        table: TableWriter,
        trackers: Sequence[Tracker] = (),
    ):
        def score(state: TrainState, seed: jax.Array) -> dict[str, jax.Array]:
            return evaluate(
                members.env,
                members.algorithm,
                state,
                key=evaluation_key(seed, state.iteration),
                num_episodes=num_episodes,
            )

        self.table, self.seconds = table, 0.0
        self.interval = Interval(every, members.config)
        self._members, self._trackers = members, trackers
        self._seeds = members.to_devices(np.array(members.seeds, np.uint32))
        self._score = members.vmap(score)

    def score(self, states: Any, done: int) -> dict[str, np.ndarray]:
        """Evaluate, write and log; return evaluations.csv's columns, (members,)."""
        started = time.monotonic()
        episodes = jax.tree.map(np.asarray, self._score(states, self._seeds))
        episodes = self._members.trim(episodes)
        returns, length = episodes["episode_return"], episodes["episode_length"]
        scores = {
            "env_steps": np.full(len(returns), done * self._members.config.batch_steps),
            "mean": returns.mean(axis=1),
            "min": returns.min(axis=1),
            "max": returns.max(axis=1),
            "length": length.mean(axis=1),
        }
        self.table.write({name: x[:, None] for name, x in scores.items()})
        for tracker in self._trackers:
            tracker.log(int(scores["env_steps"][0]), {"evaluation": scores["mean"]})
        self.seconds += time.monotonic() - started
        return scores
