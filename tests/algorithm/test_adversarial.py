"""The discriminator's gradient and the bonus against the paper's formulas."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

import gasil_jax
from gasil_jax.agents import adversarial
from gasil_jax.testing import example_context


def test_gradient_is_the_papers():
    """E_pi[grad log D] + E_B[grad log(1 - D)], D = sigmoid(w . x), by hand."""
    rng = np.random.default_rng(0)
    policy, good = rng.normal(size=(2, 6, 4))
    w = rng.normal(size=4)
    sigmoid = lambda x: 1 / (1 + np.exp(-x))
    ascent = np.mean([(1 - sigmoid(x @ w)) * x for x in policy], axis=0) + np.mean(
        [-sigmoid(x @ w) * x for x in good], axis=0
    )
    descent = jax.grad(
        lambda w: adversarial.loss(
            jnp.asarray(policy, jnp.float32) @ w,
            jnp.asarray(good, jnp.float32) @ w,
            0.0,
        )[0]
    )(jnp.asarray(w, jnp.float32))
    np.testing.assert_allclose(descent, -ascent, rtol=1e-4, atol=1e-6)


def test_entropy_is_the_bernoulli_entropy():
    logits = np.linspace(-3, 3, 7)
    d = 1 / (1 + np.exp(-logits))
    entropy = np.mean(-d * np.log(d) - (1 - d) * np.log(1 - d))
    half = jnp.asarray(logits, jnp.float32)
    without = adversarial.loss(half, half, 0.0)[0]
    with_entropy = adversarial.loss(half, half, 1.0)[0]
    np.testing.assert_allclose(without - with_entropy, entropy, rtol=1e-5)


def test_the_gradient_penalty_is_its_formula():
    """For a logit w . (s, a) + (a ^ 2) / 2, whose gradient is known."""
    rng = np.random.default_rng(0)
    observations, actions = rng.normal(size=(2, 5, 3)), rng.normal(size=(2, 5, 2))
    w, share = rng.normal(size=5), rng.random(5)
    logit = lambda s, a: jnp.concatenate([s, a], -1) @ w + 0.5 * jnp.sum(a**2, -1)
    between = share[:, None] * actions[0] + (1 - share[:, None]) * actions[1]
    gradient = np.concatenate([np.tile(w[:3], (5, 1)), w[3:] + between], axis=-1)
    expected = np.mean((np.linalg.norm(gradient, axis=-1) - 1) ** 2)
    pairs = [(jnp.array(observations[i]), jnp.array(actions[i])) for i in range(2)]
    result = adversarial.gradient_penalty(logit, *pairs, share=jnp.array(share))
    np.testing.assert_allclose(result, expected, rtol=1e-4)


def test_accuracy_is_the_share_that_is_told_apart():
    metrics = adversarial.loss(
        jnp.array([2.0, -1.0, 3.0, 1.0]), jnp.array([-1.0, 4.0]), 0.0
    )[1]
    assert metrics["discriminator_policy_accuracy"] == 0.75
    assert metrics["discriminator_good_accuracy"] == 0.5


def test_an_absorbing_state_is_paid_for_ever():
    """Its logit and the bonus, in NumPy, from the buffer's and the batch's episodes."""
    env = gasil_jax.make_env("sparse:u_maze", max_episode_steps=8)
    agent = gasil_jax.PPOGASIL(bonus="absorbing", buffer_steps=20)
    config = gasil_jax.Config(batch_steps=128, num_envs=4, minibatch_size=64)
    key = jax.random.key(0)
    algorithm = gasil_jax.Algorithm(agent, config=config)
    context = jax.jit(lambda key: example_context(env, algorithm, key))(key)
    # All episodes of one environment terminate, and return most.
    batch = context.rollout
    first = jnp.arange(4) == 1
    batch = batch.replace(
        terminated=batch.ended & first[None],
        truncated=batch.ended & ~first[None],
        discounted_return=jnp.where(first, 1.0, 0.0)[None] + batch.discounted_return,
    )
    context = context.replace(rollout=batch)
    sizes = gasil_jax.context.sizes_of(env, 4, 40)
    state = jax.jit(lambda x: agent.remember(agent.init(key, sizes), x))(context)
    # 20 steps of episodes of 8: the third is cut, so its end is not in the buffer.
    np.testing.assert_array_equal(state.buffer.terminated, [True] * 16 + [False] * 4)
    discounted = lambda lengths: sum(0.99**x for x in lengths) + 0.5
    good = discounted([8, 8]) / 4
    ends = np.array(batch.terminated & batch.completed)
    count = np.sum(np.array(batch.completed)) + 1
    policy = discounted(np.array(batch.episode_length)[ends]) / count
    logit = np.log(policy / good)
    after = 0.99 / (1 - 0.99) * np.log1p(np.exp(-logit))

    @functools.partial(jax.jit, static_argnums=0)
    def score(bonus, state, context):
        source = agent.source(state.buffer)
        scorer = agent.replace(bonus=bonus)
        return scorer.update_and_score(state.discriminator, source, context, key)[1]

    bonuses = [score(bonus, state, context) for bonus in ("absorbing", "softplus")]
    expected = np.where(batch.terminated, after, 0.0)
    assert expected.any()
    np.testing.assert_allclose(bonuses[0] - bonuses[1], expected, rtol=1e-4, atol=1e-4)


def test_the_buffer_keeps_how_episodes_ended_only_where_that_is_used():
    sizes = gasil_jax.context.Sizes(4, 3, 2, 40)
    assert gasil_jax.PPOGASIL().init_buffer(sizes).terminated is None
    assert (
        gasil_jax.PPOGASIL(bonus="absorbing").init_buffer(sizes).terminated.any() == 0
    )
