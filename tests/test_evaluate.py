"""Saving, loading and scoring a run's policies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gasil_jax
from gasil_jax import checkpoint, evaluate, numpy_policy, policy

CONFIG = gasil_jax.Config(
    agent="ppo+gasil",
    total_steps=1024,
    num_envs=4,
    batch_steps=512,
    hidden_sizes=(16, 8),
    num_epochs=1,
)


@pytest.fixture(scope="module")
def trained():
    env = gasil_jax.make_env("point_mass", reward_delay=7)
    train = gasil_jax.make_train(env, CONFIG)
    keys = jax.vmap(jax.random.key)(jnp.arange(2))
    return env, jax.jit(jax.vmap(train))(keys)[0]


def test_a_saved_state_is_loaded_bit_by_bit(trained, tmp_path):
    _, states = trained
    checkpoint.save(tmp_path / "state", states)
    like = jax.eval_shape(lambda: states)
    loaded = checkpoint.restore(tmp_path / "state", like)
    assert jax.tree.structure(loaded) == jax.tree.structure(states)
    plain = lambda x: (
        jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    )
    jax.tree.map(
        lambda a, b: np.testing.assert_array_equal(plain(a), plain(b)), loaded, states
    )


def test_a_state_of_another_shape_is_refused(trained, tmp_path):
    _, states = trained
    checkpoint.save(tmp_path / "state", states)
    other = jax.eval_shape(lambda: jax.tree.map(lambda x: x[:1], states))
    with pytest.raises(ValueError, match="holds another state"):
        checkpoint.restore(tmp_path / "state", other)
    with pytest.raises(ValueError, match="holds another state"):
        checkpoint.restore(tmp_path / "state", other.replace(imitation=()))


def test_scores_are_those_of_a_plain_loop(trained):
    env, states = trained
    state = gasil_jax.member(states, 1)
    key = jax.random.key(3)
    scores = jax.jit(lambda s: evaluate.evaluate(env, CONFIG, s, key, num_episodes=3))(
        state
    )
    act = numpy_policy.make(policy.weights(state, env))
    step = jax.jit(env.step)
    for i, reset_key in enumerate(jax.random.split(jax.random.split(key)[0], 3)):
        running, total, length = env.reset(reset_key), 0.0, 0
        while not running.done:
            running = step(running, jnp.asarray(act(np.asarray(running.obs))))
            total += float(running.info["true_reward"])
            length += 1
        np.testing.assert_allclose(scores["episode_return"][i], total, rtol=1e-3)
        assert int(scores["episode_length"][i]) == length == 50


def test_stochastic_scores_vary_more(trained):
    env, states = trained
    score = lambda deterministic: evaluate.evaluate(
        env,
        CONFIG,
        gasil_jax.member(states, 0),
        jax.random.key(0),
        num_episodes=50,
        deterministic=deterministic,
    )["episode_return"]
    assert float(jnp.std(score(False))) > float(jnp.std(score(True)))
