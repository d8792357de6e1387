"""The agents of the experiments: a constant bonus, and cloning that fades."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_training import SETTINGS

import gasil_jax
from experiments.agents.adaptive_cloning import PPOBCAdaptive
from experiments.agents.constant_bonus import PPOBonus
from gasil_jax.testing import example_context

ENV, KEY = gasil_jax.make_env("point_mass"), jax.random.key(0)
CONFIG = gasil_jax.Config(**SETTINGS).replace(batch_steps=256)
CLONING = gasil_jax.Algorithm(PPOBCAdaptive(buffer_steps=100), config=CONFIG)


def test_a_constant_bonus_is_paid_for_every_step():
    algorithm = gasil_jax.Algorithm(PPOBonus(alpha=0.7), config=CONFIG)
    context = jax.jit(lambda key: example_context(ENV, algorithm, key))(KEY)
    _, rewards, _ = algorithm.agent.update_and_reward((), context, KEY)
    np.testing.assert_allclose(rewards - context.rollout.reward, 0.7, rtol=1e-5)


@functools.cache
def context_and_state():
    agent = CLONING.agent
    sizes = gasil_jax.context.sizes_of(ENV, CLONING.config.num_envs, 200)

    @jax.jit
    def first(key):
        context = example_context(ENV, CLONING, key)
        return context, agent.remember(agent.init(key, sizes), context)

    return first(KEY)


@functools.cache
def networks():
    """The networks after an iteration: Adam's first steps have no unit."""

    @jax.jit
    def first(key):
        state = gasil_jax.init(ENV, CLONING, key)
        return gasil_jax.train_step(ENV, CLONING, state)[0].actor_critic

    return first(KEY)


@jax.jit
def update(agent, state, networks, context):
    return agent.update_policy(state, networks, context, KEY)[1:]


def cloned(agent, state):
    """The policy after cloning in the context, and the metrics."""
    context, _ = context_and_state()
    actor_critic, metrics = update(agent, state, networks(), context)
    return actor_critic.policy, metrics


def distance(first, second):
    pairs = zip(jax.tree.leaves(first.params), jax.tree.leaves(second.params))
    return max(float(np.abs(x - y).max()) for x, y in pairs)


@pytest.mark.parametrize("behind", [0.3, 0.1, 0.0, -0.1])
def test_the_weight_is_the_gap_in_quarters_of_the_buffers_return(behind):
    _, state = context_and_state()
    filled = int(state.buffer.size)
    good = np.array(state.buffer.return_)[:filled].mean()
    policy_return = np.float32(good - behind * abs(good))
    weight = min(max((good - policy_return) / (0.25 * abs(good)), 0.0), 1.0)
    policy, metrics = cloned(
        CLONING.agent, state.replace(policy_return=jnp.float32(policy_return))
    )
    np.testing.assert_allclose(metrics["return_gap"], weight, atol=1e-5)
    # It is PPO+BC with the weight as a factor, and PPO's own policy without weight.
    full = CLONING.agent.behavior_cloning_coefficient
    plain = gasil_jax.PPOBC(buffer_steps=CLONING.agent.buffer_steps)
    of = lambda x: cloned(plain.replace(behavior_cloning_coefficient=x), state)[0]
    expected = of(full * metrics["return_gap"]) if weight > 0 else networks().policy
    assert distance(policy, expected) < 1e-6 < distance(policy, of(0.5 * full))
    assert (distance(policy, of(full)) > 1e-6) == (weight < 1)


def test_the_policy_is_followed_and_left_alone_while_nothing_is_kept():
    context, state = context_and_state()
    batch = context.rollout
    ended = np.array(batch.discounted_return)[np.array(batch.completed)]
    assert len(ended) > 0 and state.has_episodes
    np.testing.assert_allclose(state.policy_return, ended.mean(), rtol=1e-5)
    empty = state.replace(buffer=state.buffer.replace(size=jnp.int32(0)))
    policy, metrics = cloned(CLONING.agent, empty)
    assert np.isnan(metrics["return_gap"])
    assert distance(policy, networks().policy) == 0.0
