"""The training loop on the point mass."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gasil_jax
from gasil_envs.gymnax_adapter import GymnaxEnv
from gasil_jax import learner

CONFIG = gasil_jax.Config(num_envs=4, num_epochs=2, hidden_sizes=(16,))
CONFIG = CONFIG.replace(total_steps=512, batch_steps=256, minibatch_size=64)
IMITATION = {"discriminator_updates": 2, "buffer_steps": 100}
IMITATION |= {"discriminator_hidden_sizes": (16,)}
AGENTS = (
    gasil_jax.PPO(),
    gasil_jax.PPOBC(buffer_steps=100),
    gasil_jax.PPONovelty(),
    gasil_jax.PPOBCNovelty(buffer_steps=100),
    gasil_jax.PPOGASILNovelty(**IMITATION),
    gasil_jax.PPOSIL(sil_buffer_steps=500, sil_minibatch_size=64),
    gasil_jax.GASIL(**IMITATION),
    gasil_jax.PPOGASIL(**IMITATION),
    gasil_jax.PPOGASILAdaptive(**IMITATION),
)
#: A small algorithm of each agent, by the agent's name.
SMALL = {agent.name: gasil_jax.Algorithm(agent, config=CONFIG) for agent in AGENTS}
PPO, PPO_GASIL = SMALL["ppo"], SMALL["ppo+gasil"]


def test_it_trains_an_environment_of_brax():
    env = gasil_jax.make_env("brax:fast", max_episode_steps=50)
    assert env.observation_size == env.unwrapped.observation_size
    algorithm = SMALL["ppo+bc"].replace(total_steps=1024)
    state, metrics = jax.jit(gasil_jax.make_train(env, algorithm))(jax.random.key(0))
    assert np.all(np.isfinite(metrics["policy_loss"]))
    # No episode ends by itself, and none is longer than the limit.
    assert set(np.asarray(metrics["episode_length"])) == {50.0}
    assert int(state.agent.buffer.size) > 0


def test_a_state_may_begin_outside_of_jit_and_be_donated():
    """With noise the environment's state holds keys."""
    env = gasil_jax.make_env("point_mass", obs_noise=0.1)
    key = jax.random.key(0)
    iterate = lambda state: gasil_jax.train_step(env, PPO, state)[0]
    step = jax.jit(iterate, donate_argnums=0)
    result = step(gasil_jax.init(env, PPO, key))
    expected = step(jax.jit(lambda key: gasil_jax.init(env, PPO, key))(key))
    # Compiled, the first state may be rounded in another way.
    close = functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-7)
    jax.tree.map(close, result.actor_critic, expected.actor_critic)


def test_double_precision_is_refused():
    env = gasil_jax.make_env("point_mass")
    with jax.enable_x64(True):
        with pytest.raises(ValueError, match="jax_enable_x64 is True"):
            gasil_jax.make_train(env, PPO_GASIL)
        with pytest.raises(ValueError, match="jax_enable_x64 is True"):
            gasil_jax.init(env, PPO_GASIL, jax.random.key(0))
        for make in (gasil_jax.make_env, GymnaxEnv):
            with pytest.raises(ValueError, match="jax_enable_x64 is True: environm"):
                make("point_mass")
        policy = gasil_jax.load_policy("zoo:walker2d-delayed")
        for key in (None, jax.random.key(0)):
            assert policy(np.zeros(17), key).dtype == np.float32


@pytest.mark.parametrize("agent", ["ppo+sil", "ppo+gasil-adaptive"])
def test_no_random_key_is_used_twice(agent):
    env = gasil_jax.make_env("point_mass")
    with jax.debug_key_reuse(True):
        train = jax.jit(gasil_jax.make_train(env, SMALL[agent]))
        jax.eval_shape(train, jax.random.key(0))


def test_an_update_that_is_not_finite_is_as_if_it_had_not_been():
    old = {"weights": jnp.array([1.0, 2.0]), "count": jnp.int32(3)}
    fine = {"weights": jnp.array([5.0, 6.0]), "count": jnp.int32(4)}
    healthy, kept = learner.keep_if_finite(fine, old)
    assert healthy and kept["weights"].tolist() == [5.0, 6.0] and kept["count"] == 4
    bad = {"weights": jnp.array([5.0, jnp.inf]), "count": jnp.int32(4)}
    healthy, kept = learner.keep_if_finite(bad, old)
    assert not healthy and kept["weights"].tolist() == [1.0, 2.0] and kept["count"] == 3
    # What the update did not touch is not its fault, and is not copied.
    buffer = {"buffer": jnp.array([jnp.nan])}
    healthy, kept = learner.keep_if_finite({**fine, **buffer}, {**old, **buffer})
    assert healthy and kept["buffer"] is buffer["buffer"] and kept["count"] == 4
    # An agent of the user's may return Python's own numbers.
    healthy, kept = learner.keep_if_finite({"loss": 2.0}, {"loss": jnp.float32(1)})
    assert healthy and kept["loss"] == 2.0
