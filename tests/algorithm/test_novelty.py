"""PPO+NOVELTY and PPO+BC+NOVELTY: visits, bonus, and which ties the buffer keeps."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

import gasil_jax
from gasil_jax import normalization
from gasil_jax.agents.behavior_cloning import PPOBC
from gasil_jax.agents.novelty import PPOBCNovelty, PPONovelty
from gasil_jax.testing import example_context

ENV = gasil_jax.make_env("sparse:u_maze", max_episode_steps=8)
CONFIG = gasil_jax.Config(batch_steps=128, num_envs=4, minibatch_size=64)
KEY = jax.random.key(0)


@functools.cache
def first_context():
    """Of an agent with a buffer; the others here are given the same."""
    algorithm = gasil_jax.Algorithm(PPOBC(), config=CONFIG)
    return jax.jit(lambda key: example_context(ENV, algorithm, key))(KEY)


@functools.partial(jax.jit, static_argnums=0)
def remembered(agent, context):
    """The agent's first state with the context's episodes."""
    sizes = gasil_jax.context.sizes_of(ENV, 4, 40)
    return agent.remember(agent.init(KEY, sizes), context)


def test_novelty_is_one_over_the_root_of_the_visits():
    agent = PPONovelty()
    context = first_context()
    # Two places, far apart: one step in one of them, all others in the other.
    places = jnp.zeros_like(context.rollout.next_observation).at[0, 0].set(1e3)
    context = context.replace(
        rollout=context.rollout.replace(next_observation=places),
        normalizer=normalization.init(ENV.observation_size),
    )
    state = agent.init(KEY, gasil_jax.context.sizes_of(ENV, 4))
    for batches in (1, 2):
        state = agent.remember(state, context)
        novelty = np.array(agent.novelty(state.visits, context))
        assert novelty[0, 0] == np.float32(batches**-0.5)
        np.testing.assert_allclose(novelty[1:], (127 * batches) ** -0.5, rtol=1e-6)
    _, reward, metrics = agent.update_and_reward(state, context, KEY)
    bonus = reward - context.rollout.reward
    np.testing.assert_allclose(jnp.mean(bonus), 0.0, atol=1e-6)
    np.testing.assert_allclose(bonus, 0.1 * (novelty - novelty.mean()), atol=1e-6)
    np.testing.assert_allclose(metrics["novelty"], novelty.mean(), rtol=1e-6)


def test_of_episodes_with_equal_returns_the_novel_ones_are_kept():
    agent = PPOBCNovelty(buffer_steps=8, buffer_episodes=1)
    context = first_context()
    batch = context.rollout
    # Environment 2 is alone where it is; the history has its observations too.
    places = jnp.zeros_like(batch.next_observation).at[:, 2].set(1e3)
    context = context.replace(
        rollout=batch.replace(next_observation=places, reward=0.0 * batch.reward),
        normalizer=normalization.init(ENV.observation_size),
    )
    for kind, novel in ((agent, True), (PPOBC(buffer_steps=8), False)):
        buffer = remembered(kind, context).buffer
        first = np.array(buffer.action[0])
        env = int(np.where((np.array(batch.action) == first).all(-1))[1][0])
        assert buffer.size > 0 and (env == 2) == novel
