"""The buffer against a plain Python list that does the same."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gasil_jax import good_trajectories, normalization

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
def push(buffer, history, observation, ended, return_, length, max_episodes=None):
    action = -observation
    history = good_trajectories.record(
        history, observation, action, reward=jnp.zeros_like(return_), ended=ended
    )
    episodes = good_trajectories.ended_episodes(history, ended, return_, length=length)
    buffer = good_trajectories.insert(
        buffer, history, episodes, max_episodes=max_episodes
    )
    return buffer, history


def empty():
    return (
        good_trajectories.init(CAPACITY, 1, 1),
        good_trajectories.init_history(
            NUM_ENVS, NUM_STEPS, MAX_EPISODE, observation_size=1, action_size=1
        ),
    )


step = st.tuples(
    st.booleans(), st.sampled_from([-2.0, 0.0, 1.0, 1.5, float("nan"), float("inf")])
)
batches = st.lists(
    st.lists(
        st.lists(step, min_size=NUM_ENVS, max_size=NUM_ENVS),
        min_size=NUM_STEPS,
        max_size=NUM_STEPS,
    ),
    min_size=1,
    max_size=6,
)


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
            buffer,
            history,
            observation,
            ended,
            return_,
            length,
            max_episodes=max_episodes,
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


def test_an_episode_that_spans_batches_enters_whole():
    going, end = (False, 0.0), (True, 3.0)
    buffer, _ = replay([batch_of(going, going, going), batch_of(end, going, going)])
    np.testing.assert_array_equal(buffer.observation[:4, 0], [1, 3, 5, 7])


def test_the_last_admitted_episode_is_cut_and_ties_go_to_the_older():
    going, end = (False, 0.0), (True, 1.0)
    buffer, reference = replay([batch_of(going, going, end)] * 3)
    assert int(buffer.size) == CAPACITY
    np.testing.assert_array_equal(buffer.time, [0, 1, 2, 0, 1, 2, 0])
    np.testing.assert_array_equal(
        buffer.observation[:, 0], [s[3] for s in reference.steps]
    )


def rows_of(ends, values):
    """A history of one environment, and its episodes, of a length and a return each."""
    total = sum(length for length, _ in ends)
    ended, return_, length = (np.zeros((total, 1), x) for x in (bool, float, int))
    last = np.cumsum([length for length, _ in ends]) - 1
    ended[last, 0] = True
    length[last, 0], return_[last, 0] = zip(*ends)
    history = good_trajectories.init_history(
        1, total, total, observation_size=values.shape[1], action_size=1
    )
    history = good_trajectories.record(
        history, values[:, None], np.zeros((total, 1, 1)), reward=return_, ended=ended
    )
    return history, good_trajectories.ended_episodes(
        history, ended, return_, length=length, terminated=ended
    )


def test_with_numbers_to_rank_by_no_part_of_an_episode_is_kept():
    history, episodes = rows_of([(3, 3.0), (5, 2.0), (2, 1.0)], np.ones((10, 1)))
    empty = good_trajectories.init(CAPACITY, 1, 1, keep_terminated=True)
    cut = good_trajectories.insert(empty, history, episodes)
    np.testing.assert_array_equal(cut.time, [0, 1, 2, 0, 1, 2, 3])
    # The end of an episode that is cut is not in the buffer.
    np.testing.assert_array_equal(cut.terminated, [1, 1, 1, 0, 0, 0, 0])
    keys = np.concatenate([np.zeros(CAPACITY), episodes.return_])
    whole = good_trajectories.insert(empty, history, episodes, ranked_by=keys)
    assert int(whole.size) == 3 and whole.terminated[:3].all()
    # But the best one is, if it does not fit.
    history, episodes = rows_of([(9, 3.0), (8, 2.0)], np.ones((17, 1)))
    keys = np.concatenate([np.zeros(CAPACITY), episodes.return_])
    long = good_trajectories.insert(empty, history, episodes, ranked_by=keys)
    assert int(long.size) == CAPACITY and not long.terminated.any()


def test_equal_episodes_share_whatever_an_entrys_offset():
    ramp = np.tile(np.linspace(-1, 1, 50), 40)
    values = np.stack([ramp, np.full(2000, 255.0)], axis=1).astype(np.float32)
    history, episodes = rows_of([(50, 40.0 - i) for i in range(40)], values)
    of = normalization.init(2).replace(
        mean=jnp.array([0.0, 255.0]), m2=jnp.array([1.0, 0.0]), count=jnp.float32(1)
    )
    result = good_trajectories.shared_returns(
        good_trajectories.init(100, 2, 1),
        history,
        episodes,
        normalize=functools.partial(normalization.normalize, of),
        distance=0.5,
    )
    expected = (39.0 - np.arange(40)) / (1 + np.arange(40))
    np.testing.assert_allclose(result[100:][episodes.length > 0], expected, rtol=1e-5)


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


def test_samples_by_return_prefer_the_best_episodes():
    going = (False, 0.0)
    rows = [[(True, 3.0), (True, 1.0)], [going, (True, 2.0)], [(True, 3.0), going]]
    buffer, _ = replay([rows])
    size = int(buffer.size)
    return_ = np.asarray(buffer.return_)[:size]
    expected = np.exp((return_ - return_.max()) / return_.std())
    weights = good_trajectories.return_weights(buffer)
    np.testing.assert_allclose(weights[:size], expected, rtol=1e-5)
    assert np.all(weights[size:] == 0)
    drawn, _ = good_trajectories.sample(jax.random.key(0), buffer, 6000, by_return=True)
    for observation, weight in zip(buffer.observation[:size], expected, strict=True):
        share = np.mean(np.asarray(drawn) == np.asarray(observation))
        assert abs(share - weight / expected.sum()) < 0.03


def test_vmapped_insertion_equals_one_by_one():
    rng = np.random.default_rng(0)
    members = 3
    observation = rng.normal(size=(members, NUM_STEPS, NUM_ENVS, 1)).astype(np.float32)
    ended = rng.random((members, NUM_STEPS, NUM_ENVS)) < 0.6
    return_ = rng.normal(size=ended.shape).astype(np.float32)
    length = np.ones(ended.shape, np.int32)
    buffer, history = empty()
    repeat = lambda tree: jax.tree.map(lambda x: jnp.stack([x] * members), tree)
    batched, _ = jax.vmap(push)(
        repeat(buffer), repeat(history), observation, ended, return_, length
    )
    for i in range(members):
        alone, _ = push(
            buffer, history, observation[i], ended[i], return_[i], length[i]
        )
        jax.tree.map(
            lambda a, b, i=i: np.testing.assert_array_equal(a[i], b), batched, alone
        )


def test_a_history_keeps_next_observations_beside_the_observations_if_told_to():
    zeros = jnp.zeros((2, 1))
    record = lambda history, observation: good_trajectories.record(
        history,
        observation,
        zeros[..., None],
        reward=zeros,
        ended=zeros > 0,
        next_observation=observation + 1,
    )
    history = good_trajectories.init_history(
        1, 2, 2, observation_size=1, action_size=1, keep_next=True
    )
    assert history.observation.shape == history.next_observation.shape == (1, 4, 1)
    for first in (0.0, 2.0, 4.0):
        observation = first + jnp.arange(2.0)[:, None, None]
        history = record(history, observation)
    assert history.in_time(history.observation).ravel().tolist() == [2, 3, 4, 5]
    assert history.in_time(history.next_observation).ravel().tolist() == [3, 4, 5, 6]
    history = good_trajectories.init_history(1, 2, 2, observation_size=1, action_size=1)
    assert record(history, observation).next_observation is None


SHARING_CAPACITY = 12


def shared_by_hand(episodes, distance, scale):
    """What episodes, (return, observations), are ranked by; a plain double loop."""
    order = sorted(range(len(episodes)), key=lambda i: -episodes[i][0])
    means = [np.mean(np.array(x), axis=0) / scale for _, x in episodes]
    lowest = min((return_ for return_, _ in episodes), default=0.0)
    ranked = {}
    for place, i in enumerate(order):
        apart = [np.sqrt(np.mean((means[i] - means[j]) ** 2)) for j in order[:place]]
        similar = sum(x < distance for x in apart)
        ranked[i] = (episodes[i][0] - lowest) / (1 + similar)
    return ranked


@given(st.integers(0, 2**31 - 1), st.sampled_from([0.1, 0.5, 2.0]))
@settings(max_examples=30, deadline=None)
def test_similar_episodes_share_their_return_as_by_hand(seed, distance):
    rng = np.random.default_rng(seed)
    scale = np.float32([0.5, 2.0])
    buffer = good_trajectories.init(SHARING_CAPACITY, 2, 1)
    history = good_trajectories.init_history(
        NUM_ENVS, NUM_STEPS, MAX_EPISODE, observation_size=2, action_size=1
    )
    running, ranked = [[] for _ in range(NUM_ENVS)], 0
    for _ in range(6):
        shape = (NUM_STEPS, NUM_ENVS)
        observation = rng.normal(size=(*shape, 2)).astype(np.float32)
        ended = rng.random(shape) < 0.4
        # Distinct returns, so that no tie has to be decided.
        return_ = rng.permutation(np.arange(6)).reshape(shape) + rng.random()
        length, offers = np.zeros(shape, int), {}
        for time in range(NUM_STEPS):
            for env in range(NUM_ENVS):
                running[env].append(observation[time, env])
                length[time, env] = len(running[env])
                ended[time, env] |= len(running[env]) == MAX_EPISODE
                if ended[time, env]:
                    offers[time, env] = return_[time, env], running[env]
                    running[env] = []
        history, episodes = offer(
            history, observation, ended, np.float32(return_), np.int32(length)
        )
        buffer = jax.tree.map(np.asarray, buffer)
        starts = [i for i in range(int(buffer.size)) if buffer.time[i] == 0]
        stops = [*starts[1:], int(buffer.size)]
        mine = [
            (float(buffer.return_[i]), buffer.observation[i:j])
            for i, j in zip(starts, stops)
        ]
        entries = starts + [
            SHARING_CAPACITY + time * NUM_ENVS + env for time, env in offers
        ]
        expected = shared_by_hand(mine + list(offers.values()), distance, scale)
        ranked_by = shared(buffer, history, episodes, scale, distance)
        for i, entry in enumerate(entries):
            np.testing.assert_allclose(ranked_by[entry], expected[i], rtol=1e-4)
        buffer = insert(buffer, history, episodes, ranked_by=ranked_by)
        ranked += len(entries)
    assert ranked > 6


@jax.jit
def offer(history, observation, ended, return_, length):
    action = jnp.zeros((*ended.shape, 1))
    history = good_trajectories.record(
        history, observation, action, reward=jnp.zeros(ended.shape), ended=ended
    )
    return history, good_trajectories.ended_episodes(
        history, ended, return_, length=length
    )


insert = jax.jit(good_trajectories.insert)

shared = jax.jit(
    lambda buffer, history, episodes, scale, distance: good_trajectories.shared_returns(
        buffer,
        history,
        episodes,
        normalize=lambda x: x / scale[None, None],
        distance=distance,
    )
)
