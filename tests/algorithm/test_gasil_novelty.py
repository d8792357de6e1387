"""PPO+GASIL+NOVELTY: it explores where rewards are sparse, and imitates the better."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_novelty import ENV, KEY, first_context

import gasil_jax
from gasil_jax.agents import gasil_novelty
from gasil_jax.agents.gasil_novelty import PPOGASILNovelty
from gasil_jax.buffer import init_buffer


def batch_of(returns, completed):
    """A batch whose episodes have these returns."""
    batch = first_context().rollout
    ended, all_ = (np.zeros(batch.reward.shape, x) for x in (bool, np.float32))
    ended.flat[: len(completed)], all_.flat[: len(returns)] = completed, returns
    return batch.replace(
        terminated=jnp.array(ended),
        truncated=jnp.zeros_like(batch.truncated),
        cut_short=jnp.zeros_like(batch.cut_short),
        discounted_return=jnp.array(all_),
    )


def twin(batches):
    """m and the lowest m, each episode weighted by its batch's age."""

    def mean(upto):
        weights = [0.9 ** (upto - i) for i in range(upto + 1)]
        weights = np.repeat(weights, [len(x) for x in batches[: upto + 1]])
        values = np.concatenate(batches)[: len(weights)]
        return np.average(values, weights=weights) if len(weights) else np.inf

    means = [mean(i) for i in range(len(batches))]
    return means[-1], min(means)


@functools.cache
def followed(slope=0.5):
    """The returns of many batches, and the same as arrays of whole episodes."""
    rng = np.random.default_rng(0)
    returns, batches = gasil_novelty.no_returns(), []
    for i in range(25):
        # None in the first batch; later ones rise or fall.
        count = 0 if i == 0 else int(rng.integers(2, 9))
        values = rng.normal(size=20) + slope * i
        values[rng.random(20) < 0.2] = np.nan  # of faulty episodes
        completed = np.arange(20) < count
        batches.append(values[completed & np.isfinite(values)])
        returns = gasil_novelty.follow(returns, batch_of(values, completed))
    return returns, batches


@pytest.mark.parametrize("slope", [0.2, -0.2])
def test_the_mean_return_is_of_the_latest_episodes(slope):
    returns, batches = followed(slope)
    latest, lowest = twin(batches)
    np.testing.assert_allclose(returns.mean, latest, rtol=1e-5)
    np.testing.assert_allclose(returns.lowest, lowest, rtol=1e-5)


def test_rewards_are_as_dense_as_few_or_many_steps_have_them():
    rng = np.random.default_rng(0)
    rewards = rng.normal(size=(6, 4)).astype(np.float32)
    expected = np.abs(rewards).mean() ** 2 / np.square(rewards).mean()
    np.testing.assert_allclose(gasil_novelty.density(rewards), expected, rtol=1e-5)
    for count, size in ((24, -3.0), (6, 1e-3), (1, 50.0), (0, 0.0)):
        rewards = np.where(np.arange(24) < count, np.float32(size), 0.0)
        density = gasil_novelty.density(rewards.reshape(6, 4))
        np.testing.assert_allclose(density, count / 24, rtol=1e-5)


@pytest.mark.parametrize("return_", [0.0, -123.4, 4567.8])
def test_of_equal_returns_none_is_better_and_nothing_is_gained(return_):
    returns = gasil_novelty.no_returns()
    filled = init_buffer(4, 1, 1).replace(
        return_=jnp.full(4, return_), size=jnp.int32(4)
    )
    # Nor is anything better or gained before the first episode.
    assert gasil_novelty.better(filled, returns).size == 0
    assert gasil_novelty.shares(filled, returns, 1.0) == (0.0, 0.0)
    for count in (3, 0, 7, 11):
        batch = batch_of([return_] * 20, np.arange(20) < count)
        returns = gasil_novelty.follow(returns, batch)
    assert gasil_novelty.better(filled, returns).size == 0
    shares = gasil_novelty.shares(filled, returns, max(abs(return_), 1.0))
    np.testing.assert_allclose(shares, 0.0, atol=1e-4)


def test_only_what_is_better_counts_and_by_the_share_that_is_lacked():
    returns, batches = followed()
    latest, lowest = twin(batches)
    kept = latest + np.array([3.0, 3.0, 1.5, 0.5, -0.5, -2.0])
    buffer = init_buffer(8, 1, 1)
    buffer = buffer.replace(return_=buffer.return_.at[:6].set(kept), size=jnp.int32(6))
    assert gasil_novelty.better(buffer, returns).size == 4
    gained = kept[0] - lowest + 0.07
    expected = (latest - lowest) / gained, (kept[:4].mean() - latest) / gained
    assert 0.1 < min(expected) and max(expected) < 0.9
    shares = gasil_novelty.shares(buffer, returns, 7.0)
    np.testing.assert_allclose(shares, expected, rtol=1e-4)


@pytest.mark.parametrize(
    ("has", "lacks"), [(0.0, 0.0), (0.0, 1.0), (0.8, 0.1), (1.0, 0.7)]
)
def test_the_reward_is_the_sum_of_three_with_their_weights(has, lacks, monkeypatch):
    shares = jnp.float32(has), jnp.float32(lacks)
    monkeypatch.setattr(gasil_novelty, "shares", lambda *_: shares)
    # All episodes have the same return here: none is better.
    monkeypatch.setattr(gasil_novelty, "better", lambda buffer, _: buffer)
    agent, context = PPOGASILNovelty(alpha=0.3), first_context()
    sizes = gasil_jax.context.sizes_of(ENV, 4, 40)
    state = agent.remember(agent.init(KEY, sizes), context)
    assert state.buffer.size > 0
    batch = context.rollout.replace(
        reward=jax.random.normal(KEY, context.rollout.reward.shape)
    )
    context = context.replace(rollout=batch)
    after, reward, metrics = agent.update_and_reward(state, context, KEY)
    pair = context.normalizer, batch.observation, batch.action
    logit = agent.logit(after.discriminator.params, *pair)
    bonus = -np.log(1 / (1 + np.exp(-np.array(logit, float))))
    novelty, own = (
        np.array(agent.novelty(state.visits, context)),
        np.array(batch.reward),
    )
    exploring = 1.0 - has * np.abs(own).mean() ** 2 / np.square(own).mean()
    bonus, novelty = 0.3 * (bonus - bonus.mean()), 0.1 * (novelty - novelty.mean())
    expected = own + lacks * bonus + exploring * novelty
    np.testing.assert_allclose(reward, expected, atol=1e-5)
    np.testing.assert_allclose(metrics["novelty_weight"], exploring, atol=1e-6)
    np.testing.assert_allclose(metrics["imitation_weight"], lacks, atol=1e-6)


def test_of_equal_episodes_those_with_more_novelty_in_all_come_first():
    agent, context = PPOGASILNovelty(), first_context()
    sizes = gasil_jax.context.sizes_of(ENV, 4, 40)
    state = agent.init(KEY, sizes)
    after = agent.remember(state, context)
    batch, novelty = context.rollout, np.array(agent.novelty(after.visits, context))
    longest = context.history.ended.shape[1]
    ranks = []
    for env in range(4):
        total = 0.0
        for step, ended in enumerate(np.array(batch.ended)[:, env]):
            total += novelty[step, env]
            if ended:
                return_ = float(batch.discounted_return[step, env])
                ranks.append(return_ + 1e-3 * total / longest)
                total = 0.0
    kept = np.unique(np.array(after.buffer.return_)[: int(after.buffer.size)])
    ranks = np.sort([x for x in ranks if np.isfinite(x)])  # not of faulty episodes
    assert len(kept) > 1
    np.testing.assert_allclose(kept, ranks[-len(kept) :], rtol=1e-5)


def test_it_learns_a_maze_that_pays_nothing_at_first():
    env = gasil_jax.make_env("sparse:u_maze")
    algorithm = gasil_jax.preset("sparse:u_maze", PPOGASILNovelty, action_size=2)
    algorithm = algorithm.replace(num_epochs=4, total_steps=70 * 2048)
    _, metrics = jax.jit(gasil_jax.make_train(env, algorithm))(jax.random.key(3))
    returns, imitation = (
        np.array(metrics[x]) for x in ("episode_return", "imitation_weight")
    )
    assert np.all(returns[4:8] < 0.1) and returns[-3:].mean() > 0.85
    # It imitates once something has paid, and less as it pays more often. Before, it
    # imitates what is new, a little.
    assert np.all(imitation[np.cumsum(np.nan_to_num(returns)) == 0.0] < 0.1)
    assert imitation[5] > 0.0 and imitation.max() > 0.5 > imitation[-1]
