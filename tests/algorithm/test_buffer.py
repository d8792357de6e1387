"""The buffer against a plain Python list that does the same."""

import functools
import types

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gasil_jax import buffer as good_trajectories
from gasil_jax import rollout

CAPACITY, NUM_ENVS, NUM_STEPS, MAX_EPISODE = 7, 2, 3, 5


class ListBuffer:
    """All steps ever offered, sorted; the first `capacity` are the buffer."""

    def __init__(self, max_episodes=None):
        self.steps = []  # (-return, episode, time, observation)
        self.episodes = 0
        self.max_episodes = max_episodes

    def insert(self, return_, observations):
        if np.isfinite(return_):
            self.steps += [
                (-return_, self.episodes, time, observation)
                for time, observation in enumerate(observations)
            ]
        self.episodes += 1
        best = sorted({step[:2] for step in self.steps})[: self.max_episodes]
        self.steps = [step for step in sorted(self.steps) if step[:2] in best]
        self.steps = self.steps[:CAPACITY]


@functools.partial(jax.jit, static_argnames="max_episodes")
def push(buffer, history, observation, ended, return_, length, max_episodes):
    steps = {"observation": observation, "action": -observation, "ended": ended}
    never = {"reward": jnp.zeros_like(return_), "faulty": False, "cut_short": False}
    history = rollout.record(history, types.SimpleNamespace(**steps, **never))
    buffer = good_trajectories.insert(
        buffer, history, ended, return_, length=length, max_episodes=max_episodes
    )
    return buffer, history


def empty():
    sizes = {"observation_size": 1, "action_size": 1}
    history = rollout.init_history(NUM_ENVS, NUM_STEPS, MAX_EPISODE, **sizes)
    return good_trajectories.init_buffer(CAPACITY, 1, 1), history


step = st.tuples(
    st.booleans(), st.sampled_from([-2.0, 0.0, 1.0, 1.5, float("nan"), float("inf")])
)
row = st.lists(step, min_size=NUM_ENVS, max_size=NUM_ENVS)
batch = st.lists(row, min_size=NUM_STEPS, max_size=NUM_STEPS)
batches = st.lists(batch, min_size=1, max_size=6)


def replay(batches, max_episodes=None):
    """Play batches of (ends, return) into the buffer and into the list."""
    buffer, history = empty()
    reference = ListBuffer(max_episodes)
    running = [[] for _ in range(NUM_ENVS)]
    counter = 0.0
    for batch in batches:
        observation = np.zeros((NUM_STEPS, NUM_ENVS, 1), np.float32)
        ended = np.zeros((NUM_STEPS, NUM_ENVS), bool)
        return_ = np.zeros((NUM_STEPS, NUM_ENVS), np.float32)
        length = np.zeros((NUM_STEPS, NUM_ENVS), np.int32)
        for time, row in enumerate(batch):
            for env, (ends, value) in enumerate(row):
                counter += 1.0
                observation[time, env] = counter
                running[env].append(counter)
                length[time, env] = len(running[env])
                return_[time, env] = value
                if ends or len(running[env]) == MAX_EPISODE:
                    ended[time, env] = True
                    reference.insert(value, running[env])
                    running[env] = []
        buffer, history = push(
            buffer, history, observation, ended, return_, length, max_episodes
        )
    return jax.tree.map(np.asarray, buffer), reference


@settings(max_examples=150, deadline=None)
@given(batches, st.sampled_from([None, 1, 2]))
def test_buffer_equals_a_sorted_list(batches, max_episodes):
    buffer, reference = replay(batches, max_episodes)
    expected = reference.steps
    size = int(buffer.size)
    assert size == len(expected) <= CAPACITY
    np.testing.assert_array_equal(buffer.return_[:size], [-s[0] for s in expected])
    np.testing.assert_array_equal(buffer.time[:size], [s[2] for s in expected])
    np.testing.assert_array_equal(
        buffer.observation[:size, 0], [s[3] for s in expected]
    )
    np.testing.assert_array_equal(buffer.action, -buffer.observation)
    assert np.all(buffer.return_[size:] == 0)
    assert np.all(buffer.observation[size:] == 0)


def batch_of(*rows):
    return [[row, (False, 0.0)] for row in rows]


def test_an_empty_buffer_samples_zeros_and_never_nan():
    buffer, _ = empty()
    observation, action = good_trajectories.sample(jax.random.key(0), buffer, 5)
    assert observation.shape == action.shape == (5, 1)
    assert np.all(np.asarray(observation) == 0)


def test_samples_come_uniformly_from_the_filled_part():
    buffer, _ = replay([batch_of((False, 0.0), (False, 0.0), (True, 1.0))])
    observation, _ = good_trajectories.sample(jax.random.key(0), buffer, 3000)
    values, counts = np.unique(np.asarray(observation), return_counts=True)
    np.testing.assert_array_equal(values, [1, 3, 5])
    assert np.all(np.abs(counts - 1000) < 150)
