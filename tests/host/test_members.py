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
def compiled():
    """Three members on two devices, so that one is padding.

    Of agents' states theirs has most kinds: networks, a buffer, and a model of rewards.
    Returns the members, their first states (3, ...), and the compiled iterations. Tests
    that use it are of the group "members", so that it is compiled once.
    """
    env = gasil_jax.make_env("point_mass", reward_delay=7, obs_noise=0.1)
    # An episode that is cut short has no return.
    settings = SETTINGS | DISCRIMINATOR | {"total_steps": 4 * 128, "buffer_steps": 100}
    settings |= {"stagger_episodes": False, "decompose_rewards": True}
    algorithm = gasil_jax.algorithm("ppo+gasil", **settings)
    members = make_members(env, algorithm, [3, 4, 5], devices=jax.devices()[:2])
    states, advance = members.compile()
    return members, jax.tree.map(jnp.asarray, members.trim(states)), advance


def trained(states, iterations=4):
    """Train them from first states; return the last ones, and metrics (3, ...)."""
    members, _, advance = compiled()
    states, rows = members.to_devices(states), []
    for iteration in range(iterations):
        states, new = members.train(advance, states, iteration, 1)
        rows.append(new)
    joined = {name: np.concatenate([x[name] for x in rows], axis=1) for name in new}
    return jax.tree.map(jnp.asarray, members.trim(states)), joined


@pytest.mark.xdist_group("members")
def test_a_members_result_is_its_own():
    """With a seed and numbers of its own it is trained as `make_train` trains it."""
    members, states, _ = compiled()
    half = {x: 0.5 * y for x, y in members.algorithm.hyperparameters.items()}
    del half["initial_std"]  # The first states are already drawn.
    numbers = {x: states.hyperparameters[x].at[1].set(half[x]) for x in half}
    numbers = {**states.hyperparameters, **numbers}
    states, metrics = trained(states.replace(hyperparameters=numbers))
    train = jax.jit(gasil_jax.make_train(members.env, members.algorithm))
    state, own = train(jax.random.key(members.seeds[1]), half)
    # A batch of another size is summed in another order, and learning lets that grow.
    close = lambda a, b: np.testing.assert_allclose(a[1], b, rtol=2e-3, atol=2e-4)
    ours, theirs = (x.actor_critic.params for x in (states, state))
    jax.tree.map(close, (metrics, ours), (own, theirs))
    returns = metrics["episode_return"]
    assert np.nanmax(np.abs(returns[0] - returns[1])) > 0.1


def test_it_is_its_own_where_the_environment_calls_the_host():
    env = gasil_jax.make_env("halfcheetah", physics="mujoco")

    def last_observation(seed):
        state = env.reset(jax.random.key(seed))
        for action in (0.5, -0.5):
            state = env.step(state, jnp.full(env.action_size, action))
        return state.obs

    # Three members on two devices: one is padding.
    algorithm, seeds = gasil_jax.algorithm("ppo"), [5, 6, 7]
    members = make_members(env, algorithm, seeds, devices=jax.devices()[:2])
    padded = members.to_devices(np.array(seeds, np.uint32))
    together = members.trim(members.vmap(last_observation)(padded))
    assert len(np.unique(together, axis=0)) == 3
    for seed, observation in zip(seeds, together, strict=True):
        alone = jax.jit(last_observation)(np.uint32(seed))
        np.testing.assert_allclose(observation, alone, rtol=1e-4, atol=1e-5)
