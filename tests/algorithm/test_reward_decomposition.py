"""Decomposition of delayed rewards against plain loops, and its use in training."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_train import SMALL

import gasil_jax
from gasil_jax import normalization, rollout
from gasil_jax.context import Context, Sizes
from gasil_jax.distributions import GAUSSIAN
from gasil_jax.rewards import decomposition
from gasil_jax.rollout import Rollout

NUM_ENVS, NUM_STEPS, LIMIT, OBS, ACT = 3, 8, 20, 2, 1
CONFIG = gasil_jax.Config(
    num_envs=NUM_ENVS, batch_steps=NUM_ENVS * NUM_STEPS, minibatch_size=NUM_STEPS
)
MODEL = gasil_jax.Decompose(
    decomposition_window_steps=4,
    decomposition_minibatch_size=32,
    decomposition_hidden_sizes=(16,),
)


windows = jax.jit(decomposition.windows)


def random_batches(seed, num_batches, delay=5):
    """Batches of episodes whose true reward is a function of the step.

    It is paid every `delay` steps and at an episode's end.
    """
    rng = np.random.default_rng(seed)
    held, age = np.zeros(NUM_ENVS), np.zeros(NUM_ENVS, int)
    for _ in range(num_batches):
        shape = (NUM_STEPS, NUM_ENVS)
        observation = rng.normal(size=(*shape, OBS)).astype(np.float32)
        action = rng.normal(size=(*shape, ACT)).astype(np.float32)
        true = observation[..., 0] + 0.5 * np.clip(action[..., 0], -1, 1) + 1.0
        ended = rng.random(shape) < 0.1
        faulty = ended & (rng.random(shape) < 0.2)
        paid = np.zeros(shape, np.float32)
        for t in range(NUM_STEPS):
            held, age = held + true[t], age + 1
            ended[t] |= age >= LIMIT
            now = ended[t] | (age % delay == 0)
            paid[t] = np.where(now & ~faulty[t], held, 0.0)
            held, age = np.where(now, 0.0, held), np.where(ended[t], 0, age)
        zeros = np.zeros(shape, np.float32)
        yield Rollout(
            observation=observation,
            next_observation=rng.normal(size=(*shape, OBS)).astype(np.float32),
            action=action,
            log_prob=zeros,
            reward=paid,
            terminated=ended,
            truncated=np.zeros(shape, bool),
            episode_return=zeros,
            discounted_return=zeros,
            episode_length=np.zeros(shape, np.int32),
            faulty=faulty,
            cut_short=ended & ~faulty & (rng.random(shape) < 0.2),
        )


@jax.jit
def decompose_once(state, history, batch, key, learning_rate):
    history = rollout.record(history, batch)
    context = Context(
        rollout=batch,
        history=history,
        normalizer=normalization.init(OBS),
        reward_scale=jnp.float32(1.0),
        action_range=(-1.0, 1.0),
        config=CONFIG,
        policy=None,
        distribution=GAUSSIAN,
        value=None,
    )
    model = MODEL.replace(decomposition_learning_rate=learning_rate)
    state, context, _, metrics = model.update(state, context, key)
    return state, history, context.rollout.reward, metrics


def decompose_all(batches, failed=()):
    """Decompose all batches; updates of the network after some of them are infinite."""
    sizes = {"observation_size": OBS, "action_size": ACT, "keep_next": True}
    history = rollout.init_history(NUM_ENVS, NUM_STEPS, LIMIT, **sizes)
    history_steps = history.reward.shape[1]
    state = MODEL.init(
        jax.random.key(0), Sizes(CONFIG.num_envs, OBS, ACT, history_steps)
    )
    for i, batch in enumerate(batches):
        key, rate = jax.random.key(i), jnp.inf if i in failed else 1e-3
        state, history, reward, metrics = decompose_once(
            state, history, batch, key, rate
        )
        yield state, history, np.asarray(reward), metrics


def test_windows_of_the_history_are_those_of_a_plain_loop_and_have_what_they_paid():
    """Also one that began in an earlier batch, for a replay of whole episodes."""
    batches, steps, begin_before = list(random_batches(0, 9)), [], 0
    for batch, (state, history, _, _) in zip(
        batches, decompose_all(batches), strict=True
    ):
        unknown = batch.faulty | batch.cut_short
        payout = np.where(unknown, np.nan, batch.reward)
        steps += zip(payout, batch.ended, strict=True)
        ring = history.reward.shape[1]
        # All complete windows, those that began before the history left out.
        expected = {}
        for env in range(NUM_ENVS):
            begin = 0
            for t, (payout, ended) in enumerate(steps):
                if payout[env] != 0 or ended[env]:
                    begins_inside = begin > len(steps) - ring or len(steps) < ring
                    if np.isfinite(payout[env]) and begins_inside:
                        position = ring - len(steps) + t
                        expected[env, position] = (payout[env], t + 1 - begin)
                    begin = t + 1
        result = jax.tree.map(np.asarray, windows(history))
        assert {*zip(*np.nonzero(result.ends), strict=True)} == set(expected)
        given = np.asarray(history.in_time(state.reward))
        for (env, end), (payout, length) in expected.items():
            assert result.length[env, end] == length
            assert result.payout[env, end] == np.float32(payout)
            begin = end + 1 - length
            begin_before += begin < ring - NUM_STEPS <= end
            total = given[env, begin : end + 1].sum()
            np.testing.assert_allclose(total, payout, rtol=1e-4, atol=1e-5)
    assert begin_before > 5


def test_a_failed_update_leaves_the_network_and_nothing_else():
    batches = list(random_batches(2, 5))
    usual = list(decompose_all(batches))
    failed = list(decompose_all(batches, failed=(1,)))
    before, after = (state for state, *_ in failed[:2])
    same = np.testing.assert_array_equal
    jax.tree.map(same, before.network, after.network)
    for (left, *_), (right, _, reward, _) in zip(usual, failed, strict=True):
        assert np.isfinite(reward).all()
        same(left.open_steps, right.open_steps)
        same(left.rates.mean, right.rates.mean)


def test_fit_is_r_squared_of_the_windows_that_count():
    rng = np.random.default_rng(0)
    predicted, actual = rng.normal(size=(2, 7, 3)).astype(np.float32)
    valid = rng.random((7, 3)) < 0.5
    metrics = decomposition.goodness_of_fit(predicted, actual, valid)
    p, a = predicted[valid], actual[valid]
    squared = np.mean((p - a) ** 2)
    expected = {
        "decomposition_fit": 1 - squared / np.var(a),
        "decomposition_error": np.sqrt(squared),
    }
    for name, value in expected.items():
        np.testing.assert_allclose(metrics[name], value, rtol=1e-4)
    for paid, counts in (
        (actual, np.zeros_like(valid)),
        (np.full_like(actual, -1.3), valid),
        (np.zeros_like(actual), valid),
    ):
        unknown = decomposition.goodness_of_fit(predicted, paid, counts)
        assert np.isnan(unknown["decomposition_fit"])


def test_long_windows_are_represented_by_steps_drawn_from_all_of_them():
    length = jnp.array([1, 4, 9])
    keys = jax.random.split(jax.random.key(0), 200)
    offset, weight = jax.vmap(
        lambda key: decomposition.sample_window_steps(key, length, 4)
    )(keys)
    np.testing.assert_allclose(weight.sum(axis=-1), 1.0, rtol=1e-6)
    assert (weight[:, 0] > 0).sum() == 200  # one step of it
    np.testing.assert_array_equal(offset[:, 1], np.tile(np.arange(4), (200, 1)))
    assert set(np.unique(offset[:, 2])) == set(range(9))
    # Drawn evenly: the mean of 800 numbers from 0 to 8.
    assert abs(float(offset[:, 2].mean()) - 4.0) < 0.5


# Shorter and longer than the rows of a window.
@pytest.mark.parametrize("delay", [2, 12])
def test_it_learns_the_reward_behind_the_payouts(delay):
    batches = list(random_batches(2, 150, delay))
    errors, fits = [], []
    for batch, (_, _, reward, metrics) in zip(
        batches, decompose_all(batches), strict=True
    ):
        true = batch.observation[..., 0] + 0.5 * np.clip(batch.action[..., 0], -1, 1)
        errors.append(np.mean((reward - true - 1.0)[~batch.faulty] ** 2))
        fits.append(float(metrics["decomposition_fit"]))
    # The variance of the true reward of a step is about 1.1.
    assert np.mean(errors[:3]) > 0.4
    assert np.mean(errors[-30:]) < (0.1 if delay == 2 else 0.4)
    if delay == 2:
        assert np.nanmean(fits[-30:]) > 0.9


def test_where_every_step_pays_it_changes_nothing():
    batches = list(random_batches(3, 4, delay=1))
    for batch, (state, _, reward, metrics) in zip(batches, decompose_all(batches)):
        np.testing.assert_array_equal(reward, batch.reward)
        # The network learns nothing: no window has more than one step.
        assert np.isnan(metrics["decomposition_fit"])
        assert state.network.optimizer_state.count == 0


def test_ppo_learns_from_a_return_that_is_paid_at_the_end():
    env = gasil_jax.make_env("point_mass", reward_delay=50)
    config = gasil_jax.Config(
        total_steps=20 * 2048, num_epochs=5, hidden_sizes=(64,), learning_rate=6e-4
    )
    model = gasil_jax.Decompose(
        decomposition_minibatch_size=16, decomposition_hidden_sizes=(32,)
    )
    train = gasil_jax.make_train(
        env, gasil_jax.Algorithm(gasil_jax.PPO(), (model,), config)
    )
    keys = jax.vmap(jax.random.key)(jnp.arange(2))
    returns = jax.jit(jax.vmap(train))(keys)[1]["episode_return"]
    # Without the model they are 20.0 and 16.6.
    assert (returns[:, -5:].mean(axis=1) > 22.5).all()


class Look(gasil_jax.PPOBC):
    """Reports the share of the steps that pay, in the batch and in the history."""

    def update_and_reward(self, state, context, key):
        reward = context.rollout.reward
        paid = lambda reward: jnp.mean(reward != 0.0)
        metrics = {"batch": paid(reward), "history": paid(context.history.reward)}
        return state, reward, metrics


def test_agents_and_ppo_see_decomposed_rewards_and_the_buffer_the_environments():
    env = gasil_jax.make_env("point_mass", reward_delay=50)
    config = SMALL["ppo"].config
    algorithm = gasil_jax.Algorithm(Look(), (gasil_jax.Decompose(),), config)
    train = gasil_jax.make_train(env, algorithm)
    state, metrics = jax.jit(train)(jax.random.key(0))
    # Of 50 steps one pays, of the decomposed rewards all do; half of the history is
    # not recorded yet.
    assert metrics["batch"][-1] > 0.9 and metrics["history"][-1] > 0.45
    # First episodes that were cut short have no return: NaN, and harmless.
    assert np.isnan(state.history.reward).any()
    assert np.all(metrics["skipped_updates"] == 0)
    assert jnp.nanmean(state.history.reward != 0.0) < 0.1
    assert state.agent.buffer.size > 0


def test_a_minibatch_in_parts_has_the_gradient_of_the_whole():
    rng = np.random.default_rng(0)
    rows, target = rng.normal(size=(12, 3)), rng.normal(size=12)
    gradient = jax.grad(lambda w, drawn: jnp.mean((drawn[0] @ w - drawn[1]) ** 2))
    of = lambda parts: decomposition.mean_gradient(
        gradient, jnp.ones(3), (rows, target), parts=parts
    )
    for parts in (2, 3, 12):
        np.testing.assert_allclose(of(parts), of(1), rtol=1e-5)
