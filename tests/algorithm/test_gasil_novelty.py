"""PPO+GASIL+NOVELTY: exploration fades as returns rise, better is imitated."""

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
    """m, M, S and the lowest m, each episode weighted by its batch's age."""
    ages = len(batches) - 1 - np.arange(len(batches))
    values = np.concatenate(batches)

    def mean(decay, upto):
        weights = [decay ** (upto - i) for i in range(upto + 1)]
        weights = np.repeat(weights, [len(x) for x in batches[: upto + 1]])
        drawn = values[: len(weights)]
        return np.average(drawn, weights=weights) if len(weights) else None

    latest = [mean(0.9, i) for i in range(len(batches))]
    weights = np.repeat(0.98**ages, [len(x) for x in batches])
    more = np.average(values, weights=weights)
    deviation = np.sqrt(np.average((values - more) ** 2, weights=weights))
    return latest[-1], more, deviation, min(x for x in latest if x is not None)


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
def test_progress_is_the_rise_of_returns_in_standard_deviations(slope):
    returns, batches = followed(slope)
    latest, more, deviation, lowest = twin(batches)
    np.testing.assert_allclose(returns.lowest, lowest, rtol=1e-5)
    expected = 2.0 * (latest - more) / (deviation + 1e-3 * abs(more))
    assert 0.2 < np.sign(slope) * expected < 1.0
    expected = max(expected, 0.0)
    np.testing.assert_allclose(gasil_novelty.progress(returns), expected, rtol=1e-4)


@pytest.mark.parametrize("return_", [0.0, -123.4, 4567.8])
def test_equal_returns_are_no_progress_and_nothing_is_better_than_them(return_):
    returns = gasil_novelty.no_returns()
    filled = init_buffer(4, 1, 1).replace(
        return_=jnp.full(4, return_), size=jnp.int32(4)
    )
    # Nor is anything better before the first episode.
    assert gasil_novelty.better(filled, returns).size == 0
    for count in (3, 0, 7, 11):
        batch = batch_of([return_] * 20, np.arange(20) < count)
        returns = gasil_novelty.follow(returns, batch)
    np.testing.assert_allclose(gasil_novelty.progress(returns), 0.0, atol=1e-2)
    good = gasil_novelty.better(filled, returns)
    assert good.size == 0 and gasil_novelty.lack(good, returns, 1.0) == 0


def test_only_what_is_better_counts_and_by_the_share_that_is_lacked():
    returns, batches = followed()
    latest, _, _, lowest = twin(batches)
    kept = latest + np.array([3.0, 3.0, 1.5, 0.5, -0.5, -2.0])
    buffer = init_buffer(8, 1, 1)
    buffer = buffer.replace(return_=buffer.return_.at[:6].set(kept), size=jnp.int32(6))
    good = gasil_novelty.better(buffer, returns)
    assert good.size == 4
    expected = (kept[:4].mean() - latest) / (kept[0] - lowest + 0.07)
    assert 0.1 < expected < 0.9
    np.testing.assert_allclose(
        gasil_novelty.lack(good, returns, 7.0), expected, rtol=1e-4
    )


@pytest.mark.parametrize(
    ("rise", "share"), [(0.0, 0.0), (0.0, 1.0), (0.2, 0.5), (1.0, 0.7)]
)
def test_the_reward_is_the_sum_of_three_with_their_weights(rise, share, monkeypatch):
    returns = {"progress": rise, "lack": share}
    for name, value in returns.items():
        monkeypatch.setattr(gasil_novelty, name, lambda *_, x=value: jnp.float32(x))
    # All episodes have the same return here: none is better.
    monkeypatch.setattr(gasil_novelty, "better", lambda buffer, _: buffer)
    agent, context = PPOGASILNovelty(alpha=0.3), first_context()
    sizes = gasil_jax.context.sizes_of(ENV, 4, 40)
    state = agent.remember(agent.init(KEY, sizes), context)
    assert state.buffer.size > 0
    after, reward, metrics = agent.update_and_reward(state, context, KEY)
    batch = context.rollout
    pair = context.normalizer, batch.observation, batch.action
    logit = agent.logit(after.discriminator.params, *pair)
    bonus = -np.log(1 / (1 + np.exp(-np.array(logit, float))))
    novelty = np.array(agent.novelty(state.visits, context))
    added = 0.3 * share * (bonus - bonus.mean()) + 0.1 * (novelty - novelty.mean())
    expected = np.array(batch.reward) + (1.0 - rise) * added
    np.testing.assert_allclose(reward, expected, atol=1e-5)
    np.testing.assert_allclose(metrics["novelty_weight"], 1.0 - rise, atol=1e-6)
    np.testing.assert_allclose(
        metrics["imitation_weight"], (1.0 - rise) * share, atol=1e-6
    )


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
