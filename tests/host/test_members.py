"""Members are trained together, on one or several devices."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_training import CONFIG

import gasil_jax
from gasil_jax.host.members import make_members


@functools.cache
def compiled(agent):
    """Three members on two devices, so that one is padding.

    Returns the members, their first states (3, ...), and the compiled iterations. Tests
    that use it are of the group "members AGENT", so that it is compiled once.
    """
    env = gasil_jax.make_env("point_mass", reward_delay=7, obs_noise=0.1)
    config = CONFIG.replace(
        agent=agent,
        total_steps=4 * 128,
        buffer_steps=100,
        sil_buffer_steps=200,
        sil_minibatch_size=32,
        # An episode that is cut short has no return.
        stagger_episodes=False,
    )
    members = make_members(env, config, [3, 4, 5], devices=jax.devices()[:2])
    states, advance = members.compile()
    return members, jax.tree.map(jnp.asarray, members.trim(states)), advance


@pytest.mark.xdist_group("members ppo")
def test_the_members_of_padded_states_are_taken_on_the_host():
    """Sliced by JAX, each device would get the states of all members."""
    members, states, _ = compiled("ppo")
    states = members.trim(members.to_devices(states))
    arrays = [
        jax.random.key_data(x)
        if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)
        else x
        for x in jax.tree.leaves(states)
    ]
    assert {len(x) for x in arrays} == {3}
    assert sum(isinstance(x, np.ndarray) for x in arrays) == len(arrays) - 2
    like = jax.tree.map(lambda x: (x.shape, x.dtype), members.shapes())
    assert jax.tree.map(lambda x: (x.shape, x.dtype), states) == like


def test_a_seed_does_not_depend_on_the_number_of_devices():
    """With host calls in the environment; test_determinism.py has one without."""
    env = gasil_jax.make_env("halfcheetah", physics="mujoco")
    config = CONFIG.replace(agent="ppo")
    results = []
    # Three members on two devices: one is padding.
    for devices, seeds in ((1, [6]), (2, [5, 6, 7])):
        members = make_members(env, config, seeds, devices=jax.devices()[:devices])
        states, advance = members.compile()
        last, _ = members.train(advance, states, 0, 1)
        last, _ = members.train(advance, last, 1, 1)
        results.append(jax.tree.map(np.asarray, members.trim(last).actor_critic.params))
    alone, two = results
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)
    jax.tree.map(lambda a, b: close(a[1], b[0]), two, alone)
