"""The agent of the experiments: a constant bonus."""

import jax
import numpy as np
from small_training import SETTINGS

import gasil_jax
from experiments.agents.constant_bonus import PPOBonus
from gasil_jax.testing import example_context

ENV, KEY = gasil_jax.make_env("point_mass"), jax.random.key(0)
CONFIG = gasil_jax.Config(**SETTINGS).replace(batch_steps=256)


def test_a_constant_bonus_is_paid_for_every_step():
    algorithm = gasil_jax.Algorithm(PPOBonus(alpha=0.7), config=CONFIG)
    context = jax.jit(lambda key: example_context(ENV, algorithm, key))(KEY)
    _, rewards, _ = algorithm.agent.update_and_reward((), context, KEY)
    np.testing.assert_allclose(rewards - context.rollout.reward, 0.7, rtol=1e-5)
