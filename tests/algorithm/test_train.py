"""The training loop on the point mass."""

import functools

import brax.envs
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gasil_jax
from gasil_envs.gymnax_adapter import GymnaxEnv
from gasil_jax import learner, rollout
from gasil_jax.context import merge_metrics
from gasil_jax.distributions import GAUSSIAN

CONFIG = gasil_jax.Config(
    total_steps=512,
    num_envs=4,
    batch_steps=256,
    minibatch_size=64,
    num_epochs=2,
    hidden_sizes=(16,),
)
IMITATION = {
    "discriminator_hidden_sizes": (16,),
    "discriminator_updates": 2,
    "buffer_steps": 100,
}
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


def test_an_environment_with_the_physics_of_brax_can_be_traced():
    env = gasil_jax.make_env("brax:inverted_pendulum")
    assert isinstance(env.unwrapped, brax.envs.inverted_pendulum.InvertedPendulum)
    action = jnp.zeros(env.action_size)
    state = jax.eval_shape(
        lambda key: env.step(env.reset(key), action), jax.random.key(0)
    )
    assert state.obs.shape == (env.observation_size,)


@pytest.mark.parametrize("limit", [50, 30, 1])
def test_a_limit_of_the_run_loses_no_delayed_reward(limit):
    env = gasil_jax.make_env("point_mass", reward_delay=20)
    collect = lambda key: rollout.collect(
        env,
        lambda observation: (jnp.zeros((4, 2)), jnp.zeros(2)),
        rollout.init(env, key, 4),
        key,
        distribution=GAUSSIAN,
        num_steps=limit,
        max_episode_steps=limit,
        gamma=1.0,
    )[1]
    batch = jax.jit(collect)(jax.random.key(0))
    assert batch.truncated[-1].all() and not batch.ended[:-1].any()
    earned = batch.episode_return[-1]
    np.testing.assert_allclose(batch.discounted_return[-1], earned, rtol=1e-5)
    np.testing.assert_allclose(batch.reward.sum(axis=0), earned, rtol=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"expert": "a.npz"}, r"expert is a setting of gail, not of ppo\+gasil"),
        ({"reward_clip": 1.0}, "reward_clip has no effect: normalize_rewards is off"),
        ({"alhpa": 0.1}, "setting 'alhpa' is unknown: did you mean 'alpha'"),
    ],
)
def test_a_setting_that_it_does_not_have_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        PPO_GASIL.replace(**change)


@pytest.mark.parametrize(
    ("hyperparameters", "message"),
    [
        (CONFIG, "hyperparameters is Config.*: it must be numbers by name"),
        ({"gamma": 1.5}, "gamma is 1.5"),
        ({"learning_rate": -jnp.ones(())}, "rate is -1.0"),
        ({"learning_rate": 1e-60}, "rate is 1e-60: it must be more than 0 in float32"),
        ({"alpha": np.ones(3)}, r"alpha has shape \(3,\): .*vmap"),
        ({"discriminator_updates": 1}, "discriminator_updates is not traced"),
        ({"imitation_weight": 0.5}, r"of ppo\+gasil-adaptive, not of ppo\+gasil"),
    ],
)
def test_hyperparameters_that_are_not_allowed_are_refused(hyperparameters, message):
    train = gasil_jax.make_train(gasil_jax.make_env("point_mass"), PPO_GASIL)
    with pytest.raises(ValueError, match=message):
        jax.eval_shape(lambda key: train(key, hyperparameters), jax.random.key(0))


def test_the_shape_of_a_traced_hyperparameter_is_checked():
    """jit traces all its arguments; under vmap each run has one number."""
    train = gasil_jax.make_train(gasil_jax.make_env("point_mass"), PPO_GASIL)
    many, key = {"alpha": jnp.ones(3)}, jax.random.key(0)
    with pytest.raises(ValueError, match="alpha has shape"):
        jax.eval_shape(train, key, many)
    _, metrics = jax.eval_shape(jax.vmap(train, in_axes=(None, 0)), key, many)
    assert metrics["env_steps"].shape[0] == 3


def test_an_environment_of_gymnasium_is_refused():
    with pytest.raises(
        ValueError, match=r"has no observation_size: .* Brax's interface"
    ):
        gasil_jax.make_train(gymnasium.make("CartPole-v1"), PPO_GASIL)


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


def test_a_loop_of_ones_own_begins_with_settings_that_are_allowed():
    """Else minibatches would hold the batch's last step many times."""
    env = gasil_jax.make_env("point_mass")
    with pytest.raises(ValueError, match="num_envs is 3, which does not divide"):
        gasil_jax.init(env, PPO_GASIL.replace(num_envs=3), jax.random.key(0))


def test_a_batch_of_states_is_refused():
    env = gasil_jax.make_env("point_mass")
    init = jax.vmap(lambda key: gasil_jax.init(env, PPO, key))
    pair = jax.eval_shape(lambda: init(jax.random.split(jax.random.key(0))))
    with pytest.raises(ValueError, match=r"batch of 2 states: .*jax.vmap this"):
        jax.eval_shape(lambda state: gasil_jax.train_step(env, PPO, state), pair)


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


def test_metrics_of_one_name_are_refused():
    merged = merge_metrics("ppo", {"a": jnp.int32(1)}, {"b": jnp.float32(2)})
    assert merged == {"a": 1.0, "b": 2.0}
    assert all(value.dtype == jnp.float32 for value in merged.values())
    with pytest.raises(ValueError, match="metric 'a' of ppo has the name of another"):
        merge_metrics("ppo", {"a": jnp.int32(1)}, {"a": jnp.float32(2)})


class Bad(gasil_jax.Agent):
    def update_and_reward(self, state, context, key):
        return state, context.rollout.reward, {"episode_return": 0.5}


def test_an_agents_metric_may_not_take_anothers_name():
    env = gasil_jax.make_env("point_mass")
    train = gasil_jax.make_train(env, gasil_jax.Algorithm(Bad()))
    bad = r"metric 'episode_return' of agent 'test_train:Bad' has the name of another"
    with pytest.raises(ValueError, match=bad):
        jax.eval_shape(train, jax.random.key(0))
