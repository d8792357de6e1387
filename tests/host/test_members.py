"""Members are trained together, on one or several devices."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_training import DISCRIMINATOR, SETTINGS

import gasil_jax
from gasil_jax.host.members import make_members


@functools.cache
def compiled(agent):
    """Three members on two devices, so that one is padding.

    Returns the members, their first states (3, ...), and the compiled iterations. Tests
    that use it are of the group "members AGENT", so that it is compiled once.
    """
    env = gasil_jax.make_env("point_mass", reward_delay=7, obs_noise=0.1)
    # An episode that is cut short has no return.
    algorithm = gasil_jax.algorithm(agent, **SETTINGS, stagger_episodes=False)
    sizes = {**DISCRIMINATOR, "buffer_steps": 100}
    sizes |= {"sil_buffer_steps": 200, "sil_minibatch_size": 32}
    algorithm = algorithm.replace(
        total_steps=4 * 128,
        decompose_rewards=agent == "ppo+bc+novelty",
        **{name: x for name, x in sizes.items() if name in algorithm.settings},
    )
    members = make_members(env, algorithm, [3, 4, 5], devices=jax.devices()[:2])
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


def trained(members, advance, states):
    """Return metrics and parameters, (members, ...), after all iterations."""
    metrics = []
    for iteration in range(members.config.num_iterations):
        states, new = members.train(advance, states, iteration, 1)
        metrics.append(new)
    params = jax.tree.map(np.asarray, members.trim(states).actor_critic.params)
    return {name: np.concatenate([x[name] for x in metrics], 1) for name in new}, params


@pytest.mark.xdist_group("members ppo+gasil")
def test_a_seeds_result_is_its_own():
    """It does not depend on the seeds beside it or on the number of devices."""
    members, states, advance = compiled("ppo+gasil")
    metrics, params = trained(members, advance, members.to_devices(states))
    alone = make_members(members.env, members.algorithm, [4], devices=jax.devices()[:1])
    states, advance = alone.compile()
    own = trained(alone, advance, states)
    # A batch of another size is summed in another order, and learning lets that grow.
    close = lambda a, b: np.testing.assert_allclose(a[1], b[0], rtol=2e-3, atol=2e-4)
    jax.tree.map(close, (metrics, params), own)
    returns = metrics["episode_return"]
    assert np.nanmax(np.abs(returns[0] - returns[1])) > 0.1


def test_it_is_its_own_where_the_environment_calls_the_host():
    env = gasil_jax.make_env("halfcheetah", physics="mujoco")
    algorithm = gasil_jax.algorithm("ppo", **SETTINGS)
    results = []
    # Three members on two devices: one is padding.
    for devices, seeds in ((1, [6]), (2, [5, 6, 7])):
        members = make_members(env, algorithm, seeds, devices=jax.devices()[:devices])
        states, advance = members.compile()
        results.append(trained(members, advance, states)[1])
    alone, two = results
    close = lambda a, b: np.testing.assert_allclose(a[1], b[0], rtol=1e-4, atol=1e-5)
    jax.tree.map(close, two, alone)
