"""The training loop on the point mass."""

import functools

import brax.envs
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gasil_jax
from gasil_jax import learner, rollout
from gasil_jax import train as training
from gasil_jax.imitation import AGENTS, none

SMALL = gasil_jax.Config(
    total_steps=512,
    num_envs=4,
    batch_steps=256,
    minibatch_size=64,
    num_epochs=2,
    hidden_sizes=(16,),
    discriminator_hidden_sizes=(16,),
    sil_buffer_steps=500,
    sil_minibatch_size=64,
    hyperparameters=gasil_jax.Hyperparameters(
        discriminator_updates=2, buffer_steps=100
    ),
)


def test_it_trains_an_environment_of_brax():
    env = gasil_jax.make_env("brax:fast")
    assert env.observation_size == env.unwrapped.observation_size
    config = SMALL.replace(agent="ppo", total_steps=1024, max_episode_steps=50)
    state, metrics = jax.jit(gasil_jax.make_train(env, config))(jax.random.key(0))
    assert np.all(np.isfinite(metrics["policy_loss"]))
    # No episode ends by itself, and none is longer than the limit.
    assert set(np.asarray(metrics["episode_length"])) == {50.0}
    assert int(state.good_trajectories.size) > 0


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
        ({"agent": "ppo+gasill"}, r"'ppo\+gasil'"),
        ({"num_envs": 0}, "num_envs is 0"),
        ({"num_envs": True}, "num_envs is True"),
        ({"hidden_sizes": [64, 64]}, "hidden_sizes is .* must be a tuple"),
        ({"alpha_schedule": (2e6, 0.0)}, "alpha_schedule is .*points"),
        ({"normalize_rewards": 1}, "normalize_rewards is 1: it must be True or"),
        ({"minibatch_size": 60}, "nearest that does is"),
        ({"num_envs": 3}, "num_envs is 3"),
        ({"expert": "a.npz"}, r"expert is 'a.npz': agent 'ppo.*' uses no exp"),
        ({"hyperparameters": gasil_jax.Hyperparameters(alpha=-1.0)}, "alpha is -1.0"),
        ({"hyperparameters": gasil_jax.Hyperparameters(gamma=1.5)}, "gamma is 1.5"),
        (
            {"hyperparameters": gasil_jax.Hyperparameters(alpha=np.float32(-1))},
            "alpha is -1.0",
        ),
        ({"hyperparameters": gasil_jax.Hyperparameters(alpha="x")}, "alpha is 'x'"),
    ],
)
def test_a_bad_configuration_is_refused(change, message):
    env = gasil_jax.make_env("point_mass")
    with pytest.raises(ValueError, match=message):
        gasil_jax.make_train(env, SMALL.replace(**change))


@pytest.mark.parametrize(
    ("hyperparameters", "message"),
    [
        ({"learning_rate": 1e-3}, "hyperparameters is {.*: it must be Hyperparameters"),
        (gasil_jax.Hyperparameters(gamma=1.5), "gamma is 1.5"),
        (gasil_jax.Hyperparameters(learning_rate=-jnp.ones(())), "rate is -1.0"),
        (
            gasil_jax.Hyperparameters(alpha=np.ones(3)),
            r"alpha has shape \(3,\): .*vmap",
        ),
        (gasil_jax.Hyperparameters(), "discriminator_updates is 5: .* the config's, 2"),
        (gasil_jax.Hyperparameters(discriminator_updates=jnp.float32(1.5)), "is 1.5"),
    ],
)
def test_hyperparameters_that_are_not_allowed_are_refused(hyperparameters, message):
    train = gasil_jax.make_train(gasil_jax.make_env("point_mass"), SMALL)
    with pytest.raises(ValueError, match=message):
        jax.eval_shape(lambda key: train(key, hyperparameters), jax.random.key(0))


def test_the_shape_of_a_traced_hyperparameter_is_checked():
    train = gasil_jax.make_train(gasil_jax.make_env("point_mass"), SMALL)
    # jit traces all its arguments; under vmap each run has one number.
    many = gasil_jax.Hyperparameters(alpha=jnp.ones(3))
    with pytest.raises(ValueError, match="alpha has shape"):
        jax.eval_shape(train, jax.random.key(0), many)
    axes = jax.tree.map(lambda x: 0 if jnp.ndim(x) else None, many)
    trained = jax.vmap(train, in_axes=(None, axes))
    assert (
        jax.eval_shape(trained, jax.random.key(0), many)[1]["env_steps"].shape[0] == 3
    )


def test_an_environment_of_gymnasium_is_refused():
    with pytest.raises(
        ValueError, match=r"has no observation_size: .* Brax's interface"
    ):
        gasil_jax.make_train(gymnasium.make("CartPole-v1"), SMALL)


def test_a_name_is_not_an_environment():
    with pytest.raises(ValueError, match=r"env is 'hopper', .*make_env"):
        gasil_jax.make_train("hopper", SMALL)


def test_a_state_may_begin_outside_of_jit_and_be_donated():
    """With noise the environment's state holds keys."""
    env = gasil_jax.make_env("point_mass", obs_noise=0.1)
    config = SMALL.replace(agent="ppo")
    key = jax.random.key(0)
    iterate = lambda state: gasil_jax.iterate(env, config, state)[0]
    step = jax.jit(iterate, donate_argnums=0)
    result = step(gasil_jax.init(env, config, key))
    expected = step(jax.jit(lambda key: gasil_jax.init(env, config, key))(key))
    # Compiled, the first state may be rounded in another way.
    close = functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-7)
    jax.tree.map(close, result.actor_critic, expected.actor_critic)


def test_double_precision_is_refused():
    env = gasil_jax.make_env("point_mass")
    with jax.enable_x64(True):
        with pytest.raises(ValueError, match="jax_enable_x64 is True"):
            gasil_jax.make_train(env, SMALL)
        with pytest.raises(ValueError, match="jax_enable_x64 is True"):
            gasil_jax.init(env, SMALL, jax.random.key(0))


def test_a_loop_of_ones_own_begins_with_a_config_that_is_allowed():
    """Else minibatches would hold the batch's last step many times."""
    env = gasil_jax.make_env("point_mass")
    with pytest.raises(ValueError, match="num_envs is 3, which does not divide"):
        gasil_jax.init(env, SMALL.replace(num_envs=3), jax.random.key(0))


def test_a_loop_of_ones_own_refuses_a_state_that_would_be_broadcast_or_cut():
    env = gasil_jax.make_env("point_mass")
    state = gasil_jax.init(env, SMALL, jax.random.key(0))
    traced = lambda state, **changes: jax.eval_shape(
        lambda state: gasil_jax.iterate(env, SMALL.replace(**changes), state), state
    )
    own = lambda **changes: state.replace(
        hyperparameters=state.hyperparameters.replace(**changes)
    )
    # A weight for each environment would weight the rewards of each.
    with pytest.raises(ValueError, match=r"alpha has shape \(\d+,\): .*vmap"):
        traced(own(alpha=jnp.ones(SMALL.num_envs)))
    with pytest.raises(ValueError, match=r"alpha is -1.0: it must be 0 or more"):
        gasil_jax.iterate(env, SMALL, own(alpha=-1.0))
    pair = jax.tree.map(lambda *leaves: jnp.stack(leaves), state, state)
    with pytest.raises(ValueError, match=r"batch of 2 states: .*jax.vmap this"):
        traced(pair)
    # Minibatches would hold the batch's last step many times.
    changes = {"num_envs": 2 * SMALL.num_envs}, {"batch_steps": 2 * SMALL.batch_steps}
    for change in changes:
        with pytest.raises(ValueError, match=r"environments: this config needs .* of"):
            traced(state, **change)
    # The state decides what the rewards are, not the config.
    for name in ("normalize_rewards", "decompose_rewards"):
        with pytest.raises(ValueError, match=f"{name} is True, but the state .* False"):
            traced(state, **{name: True}, decomposition_history_episodes=1)
    # What training may go on with.
    traced(own(alpha=0.3), total_steps=10 * SMALL.total_steps)


@pytest.mark.parametrize("agent", ["ppo+sil", "ppo+gasil", "ppo+gasil-adaptive"])
def test_no_random_key_is_used_twice(agent):
    env, config = gasil_jax.make_env("point_mass"), SMALL.replace(agent=agent)
    with jax.debug_key_reuse(True):
        train = jax.jit(gasil_jax.make_train(env, config))
        jax.eval_shape(train, jax.random.key(0))


def test_an_update_that_is_not_finite_is_as_if_it_had_not_been():
    old = {"weights": jnp.array([1.0, 2.0]), "count": jnp.int32(3)}
    fine = {"weights": jnp.array([5.0, 6.0]), "count": jnp.int32(4)}
    healthy, kept = learner.keep_if_finite(fine, old)
    assert healthy and kept["weights"].tolist() == [5.0, 6.0] and kept["count"] == 4
    bad = {"weights": jnp.array([5.0, jnp.inf]), "count": jnp.int32(4)}
    healthy, kept = learner.keep_if_finite(bad, old)
    assert not healthy and kept["weights"].tolist() == [1.0, 2.0] and kept["count"] == 3


def test_metrics_of_one_name_are_refused():
    merged = training.merge_metrics("ppo", {"a": jnp.int32(1)}, {"b": jnp.float32(2)})
    assert merged == {"a": 1.0, "b": 2.0}
    assert all(value.dtype == jnp.float32 for value in merged.values())
    with pytest.raises(ValueError, match="names that other metrics have: a"):
        training.merge_metrics("ppo", {"a": jnp.int32(1)}, {"a": jnp.float32(2)})


def test_an_agents_metric_may_not_take_anothers_name(monkeypatch):
    def reward(state, context, key):
        return state, context.rollout.reward, {"episode_return": 0.5}

    monkeypatch.setitem(AGENTS, "bad", none.PPO._replace(update_and_reward=reward))
    train = gasil_jax.make_train(
        gasil_jax.make_env("point_mass"), gasil_jax.Config(agent="bad")
    )
    with pytest.raises(ValueError, match=r"metrics of agent 'bad'.*episode_return"):
        jax.eval_shape(train, jax.random.key(0))
