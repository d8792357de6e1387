"""The discriminator's loss, the forms of the bonus, and when nothing is imitated."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_train import SMALL

import gasil_jax
from gasil_jax.agents import adaptive, adversarial
from gasil_jax.buffer import mean_return
from gasil_jax.context import Sizes
from gasil_jax.testing import example_context

ADAPTIVE = SMALL["ppo+gasil-adaptive"]
ENV = gasil_jax.make_env("point_mass")


@pytest.mark.parametrize(
    ("good", "policy", "expected"),
    [(100.0, 90.0, 0.4), (100.0, 60.0, 1.0), (100.0, 110.0, 0.0), (-8.0, -9.0, 0.5)],
)
def test_the_gap_is_in_units_of_a_quarter_of_the_buffers_return(good, policy, expected):
    result = adaptive.gap(jnp.float32(good), jnp.float32(policy))
    np.testing.assert_allclose(result, expected, rtol=1e-5)


def test_the_policys_return_follows_its_latest_whole_episodes():
    rng = np.random.default_rng(0)
    followed, has_episodes, twin = jnp.float32(0.0), jnp.bool_(False), None
    for _ in range(6):
        returns = rng.normal(size=(5, 3))
        completed = rng.random((5, 3)) < 0.2
        returns[rng.random((5, 3)) < 0.2] = np.nan  # of faulty episodes
        followed, has_episodes = adaptive.follow_return(
            followed, has_episodes, jnp.array(completed), return_=jnp.array(returns)
        )
        counted = returns[completed & np.isfinite(returns)]
        if len(counted):
            past = 0.0 if twin is None else 0.9 ** len(counted)
            twin = past * (twin or 0.0) + (1 - past) * counted.mean()
        if twin is not None:
            np.testing.assert_allclose(followed, twin, rtol=1e-4)
    assert has_episodes and twin is not None


@functools.cache
def context_and_state():
    """The context of the first iteration, and adaptive imitation's state with it."""
    agent, key = ADAPTIVE.agent, jax.random.key(0)
    context = jax.jit(lambda key: example_context(ENV, ADAPTIVE, key))(key)
    sizes = Sizes(ADAPTIVE.config.num_envs, ENV.observation_size, ENV.action_size)
    first = jax.jit(lambda context: agent.remember(agent.init(key, sizes), context))
    return context, first(context)


@pytest.mark.parametrize("rule", adaptive.RULES)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_rule_is_the_product_of_the_factors_in_its_name(rule, sign):
    context, state = context_and_state()
    good_return = mean_return(state.buffer)
    state = state.replace(policy_return=good_return - 0.1 * jnp.abs(good_return))
    rewards, noise = np.random.default_rng(0).normal(size=(2, 64, 4))
    streams = jnp.stack([rewards, 0.6 * sign * rewards + 0.8 * noise], axis=-1)
    agent = ADAPTIVE.agent.replace(imitation_rule=rule)
    advantage, metrics = agent.mix(state, streams, context)
    agreement = np.mean(streams[..., 0] * streams[..., 1])
    assert sign * agreement > 0.3
    expected = 0.7
    if rule in ("agreement", "both"):
        expected *= np.maximum(agreement, 0.0)
    if rule in ("gap", "both"):
        expected *= 0.4
    np.testing.assert_allclose(metrics["imitation_weight"], expected, rtol=1e-5)
    mixed = (1 - expected) * streams[..., 0] + expected * streams[..., 1]
    np.testing.assert_allclose(advantage, mixed, rtol=1e-4, atol=1e-5)


def twin(name, logit):
    """The bonus from D itself, in double precision."""
    d = 1 / (1 + np.exp(-logit))
    forms = {"softplus": -np.log(d), "logit": np.log(1 - d) - np.log(d)}
    return (forms | {"centered": -np.log(d) - np.mean(-np.log(d))})[name]


@pytest.mark.parametrize("name", adversarial.BONUSES)
def test_a_form_of_the_bonus_is_its_formula_and_pays_more_for_good_pairs(name):
    logit = np.linspace(-6.0, 6.0, 25)
    result = adversarial.BONUSES[name](jnp.asarray(logit, jnp.float32))
    np.testing.assert_allclose(result, twin(name, logit), rtol=1e-3, atol=1e-5)
    # A low logit means: not from the policy, like the buffer.
    assert np.all(np.diff(result) < 0)


@pytest.mark.parametrize(("agent", "share"), [("ppo+gasil", 1.0), ("gasil", 0.0)])
def test_the_bonus_is_added_to_the_reward_or_stands_in_its_place(agent, share):
    algorithm = SMALL[agent].replace(alpha=0.7)

    @jax.jit
    def first(key):
        agent, context = algorithm.agent, example_context(ENV, algorithm, key)
        state = agent.remember(gasil_jax.init(ENV, algorithm, key).agent, context)
        _, rewards, _ = agent.update_and_reward(state, context, key)
        _, bonus, _ = agent.update_and_score(state, context, key)
        return state.buffer.size, context.rollout.reward, bonus, rewards

    size, reward, bonus, rewards = first(jax.random.key(0))
    assert size > 0 and bonus.std() > 0.01
    expected = share * reward + 0.7 * bonus
    np.testing.assert_allclose(rewards, expected, rtol=1e-5, atol=1e-6)


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


def test_accuracy_is_the_share_that_is_told_apart():
    metrics = adversarial.loss(
        jnp.array([2.0, -1.0, 3.0, 1.0]), jnp.array([-1.0, 4.0]), 0.0
    )[1]
    assert metrics["discriminator_policy_accuracy"] == 0.75
    assert metrics["discriminator_good_accuracy"] == 0.5


def assert_equal(left, right):
    """Two pytrees are the same, bit for bit."""
    for a, b in zip(jax.tree.leaves(left), jax.tree.leaves(right), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("agent", ["ppo+bc", "ppo+sil", "ppo+gasil-adaptive"])
def test_nothing_is_imitated_while_the_buffer_is_empty(agent):
    # No episode, of 50 steps, ends within a batch of 16 steps in each environment.
    algorithm = SMALL[agent].replace(batch_steps=64, stagger_episodes=False)

    @jax.jit
    def first(key):
        used, state = algorithm.agent, gasil_jax.init(ENV, algorithm, key)
        context = example_context(ENV, algorithm, key)
        remembered = used.remember(state.agent, context)
        after, rewards, learned = used.update_and_reward(remembered, context, key)
        after, actor_critic, own = used.update_policy(
            after, state.actor_critic, context, key
        )
        reward = context.rollout.reward
        return state, remembered, reward, rewards, after, actor_critic, learned, own

    state, remembered, reward, rewards, after, actor_critic, learned, own = first(
        jax.random.key(0)
    )
    assert_equal(remembered, state.agent)
    assert_equal(actor_critic, state.actor_critic)
    if agent == "ppo+gasil-adaptive":
        np.testing.assert_array_equal(rewards[..., 0], reward)
        np.testing.assert_array_equal(rewards[..., 1], 0.0)
        assert_equal(after.discriminator, state.agent.discriminator)
    else:
        np.testing.assert_array_equal(rewards, reward)
        assert_equal(after, state.agent)
    unknown = {"ppo+bc": "behavior_cloning_loss", "ppo+sil": "sil_fraction"}.get(
        agent, "discriminator_loss"
    )
    assert np.isnan({**learned, **own}[unknown])
