"""What the tests of an agent of one's own get."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

import gasil_jax
from gasil_jax.testing import example_context


class Keeps(gasil_jax.PPOBC):
    """Keeps the context that it gets."""

    given: ClassVar = []

    def update_and_reward(self, state, context, key):
        self.given.append(context)
        return state, context.rollout.reward, {"sum": context.rollout.reward.sum()}


def test_an_example_is_what_the_first_iteration_gives():
    """Arrays by their kinds, and the batch by its numbers, which an agent has kept."""
    env, key = gasil_jax.make_env("point_mass", reward_delay=5), jax.random.key(3)
    agent = Keeps()
    small = {"batch_steps": 256, "num_envs": 2, "num_epochs": 1, "hidden_sizes": (4,)}
    more = {"learning_rate_schedule": ((0.0, 0.5), (1.0, 1.0))}
    algorithm = gasil_jax.Algorithm(agent).replace(**small, **more)
    algorithm = algorithm.replace(normalize_rewards=True)
    example = lambda key, used=algorithm: example_context(env, used, key)

    def first(key, used=algorithm):
        state = gasil_jax.init(env, used, key)
        after, metrics = gasil_jax.train_step(env, used, state)
        # What PPO does then is not compiled.
        return state.agent, after.agent, metrics["sum"]

    kinds = lambda x: jax.tree.map(
        lambda x: (jnp.shape(x), jnp.result_type(x)), x.replace(policy=None, value=None)
    )
    both = algorithm.replace(decompose_rewards=True)
    jax.eval_shape(lambda key: first(key, both), key)
    given = jax.eval_shape(lambda key: example(key, both), key)
    assert kinds(given) == kinds(agent.given[-1])

    given = jax.jit(example)(key)
    before, after, total = jax.jit(first)(key)
    assert kinds(given) == kinds(agent.given[-1])
    np.testing.assert_allclose(total, given.rollout.reward.sum(), rtol=1e-5)
    buffer, kept = jax.jit(agent.remember)(before, given).buffer, after.buffer
    assert buffer.size > 0 and buffer.size == kept.size
    np.testing.assert_allclose(buffer.observation, kept.observation, atol=1e-6)
    np.testing.assert_allclose(given.config.learning_rate, 1.5e-4)
