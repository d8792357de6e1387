"""What every environment does, also those of other packages."""

import chex
import jax
import jax.numpy as jnp
import numpy as np

from gasil_envs import wrappers

BATCH = 200


def check_reset_and_step(env, reset, step, *, same_start=False):
    """Under jit and vmap: shapes, dtypes, starts that differ, finite numbers."""
    state = reset(jax.random.split(jax.random.key(0), BATCH))
    assert state.obs.shape == (BATCH, env.observation_size)
    if not same_start:
        assert len(np.unique(state.obs, axis=0)) == BATCH  # each start is its own
    if wrappers.is_discrete(env):
        action = jax.random.randint(jax.random.key(1), (BATCH,), 0, env.num_actions)
    else:
        action = jax.random.uniform(
            jax.random.key(1), (BATCH, env.action_size), minval=-0.4, maxval=0.4
        )
    following = step(state, action)
    chex.assert_trees_all_equal_shapes_and_dtypes(state, following)
    assert following.obs.dtype == jnp.float32
    assert following.reward.shape == following.done.shape == (BATCH,)
    assert np.all(np.isfinite(following.obs)) and np.all(np.isfinite(following.reward))
    assert not np.any(following.done)
    assert not np.array_equal(state.obs, following.obs)
