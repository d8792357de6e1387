"""The training loop on the point mass."""

import functools

import brax.envs
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gasil_jax
from gasil_jax import rollout
from gasil_jax import train as training
from gasil_jax.imitation import AGENTS

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


@functools.cache
def trainer(agent="ppo+gasil"):
    env = gasil_jax.make_env("point_mass")
    return jax.jit(gasil_jax.make_train(env, SMALL.replace(agent=agent)))


# GAIL needs an expert: tests/test_gail.py.
SELF_TAUGHT = [name for name in gasil_jax.agents() if name != "gail"]


def test_vmap_over_every_hyperparameter_equals_single_runs():
    env = gasil_jax.make_env("point_mass")
    # Counts may be less than those of the configuration, which decide the shapes.
    larger = SMALL.replace(buffer_steps=130, discriminator_updates=4)
    train = gasil_jax.make_train(env, larger)
    key, plain = jax.random.key(0), SMALL.hyperparameters
    half = jax.tree.map(lambda x: 0.5 * x, plain)
    counts = {"buffer_steps": 100, "discriminator_updates": 2}
    both = (plain, half.replace(**counts))
    stacked = jax.tree.map(lambda *x: jnp.array(x), *both)
    _, swept = jax.jit(jax.vmap(train, in_axes=(None, 0)))(key, stacked)
    for i, hyperparameters in enumerate(both):
        _, single = trainer()(key, hyperparameters)
        for name in (
            "bonus",
            "policy_loss",
            "value_loss",
            "learning_rate",
            "good_steps",
        ):
            np.testing.assert_allclose(
                swept[name][i], single[name], rtol=1e-3, atol=1e-5, err_msg=name
            )
    assert np.all(swept["bonus"][0] > swept["bonus"][1])


@pytest.mark.parametrize("agent", SELF_TAUGHT)
def test_an_agent_looks_at_the_fields_that_it_says_and_at_no_others(agent):
    env = gasil_jax.make_env("point_mass")
    train = gasil_jax.make_train(env, SMALL.replace(agent=agent, total_steps=768))
    plain = SMALL.hyperparameters
    every = {name for each in AGENTS.values() for name in each.fields}
    swept = sorted(name for name in every if hasattr(plain, name))
    changed = [plain.replace(**{name: getattr(plain, name) / 2}) for name in swept]
    stacked = jax.tree.map(lambda *x: jnp.array(x), plain, *changed)
    last, _ = jax.jit(jax.vmap(train, in_axes=(None, 0)))(jax.random.key(0), stacked)
    (first, *_) = [np.asarray(x) for x in jax.tree.leaves(last.actor_critic)]
    seen = {x for x, w in zip(swept, first[1:], strict=True) if (w != first[0]).any()}
    assert seen == {name for name in AGENTS[agent].fields if name in swept}


def test_it_trains_an_environment_of_brax():
    env = gasil_jax.make_env("brax:inverted_pendulum")
    assert isinstance(env.unwrapped, brax.envs.inverted_pendulum.InvertedPendulum)
    config = SMALL.replace(agent="ppo", total_steps=1024, max_episode_steps=50)
    state, metrics = jax.jit(gasil_jax.make_train(env, config))(jax.random.key(0))
    assert np.all(np.isfinite(metrics["policy_loss"]))
    # One point for each step upright, and no episode above the limit.
    np.testing.assert_allclose(metrics["episode_return"], metrics["episode_length"])
    assert np.nanmax(metrics["episode_length"]) <= 50
    assert int(state.good_trajectories.size) > 0


@pytest.mark.parametrize("agent", SELF_TAUGHT)
def test_it_learns_on_the_point_mass(agent):
    env = gasil_jax.make_env("point_mass")
    config = gasil_jax.Config(
        agent=agent,
        total_steps=40 * 2048,
        hyperparameters=gasil_jax.Hyperparameters(
            alpha=1.0, discriminator_updates=20, discriminator_learning_rate=3e-4
        ),
    )
    keys = jax.vmap(jax.random.key)(jnp.arange(2))
    _, metrics = jax.jit(jax.vmap(gasil_jax.make_train(env, config)))(keys)
    returns = np.asarray(metrics["episode_return"])
    # From about 5 at random, a blue object now and then; both and a green one are 20.
    assert np.all(returns[:, 0] < 8.0)
    assert np.all(returns[:, -3:].mean(1) > 18.0)


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
        ({"expert": "a.npz"}, r"expert is 'a.npz': agent 'ppo.*' imitates none"),
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


def test_a_name_is_not_an_environment():
    with pytest.raises(ValueError, match=r"env is 'hopper': .*make_env"):
        gasil_jax.make_train("hopper", SMALL)


def test_a_state_may_begin_outside_of_jit_and_be_donated():
    """With noise the environment's state holds keys."""
    env = gasil_jax.make_env("point_mass", obs_noise=0.1)
    config = SMALL.replace(agent="ppo")
    key = jax.random.key(0)
    state = gasil_jax.init(env, config, key)
    step = jax.jit(lambda state: gasil_jax.iterate(env, config, state)[0])
    expected = step(jax.jit(lambda key: gasil_jax.init(env, config, key))(key))
    result = jax.jit(step, donate_argnums=0)(state)
    # A program of its own may round in another way.
    close = functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-7)
    jax.tree.map(close, result.actor_critic, expected.actor_critic)


def test_double_precision_is_refused():
    env = gasil_jax.make_env("point_mass")
    with jax.enable_x64(True):
        with pytest.raises(ValueError, match="jax_enable_x64 is True"):
            gasil_jax.make_train(env, SMALL)


def test_two_streams_of_the_same_reward_are_that_reward():
    """Each has a value of its own; with one of them at weight 0 it is plain PPO."""

    def twice(state, context, key):
        reward = context.rollout.reward
        return state, jnp.stack([reward, -3.0 * reward], axis=-1), {}

    first_alone = lambda state, advantages, context: (advantages[..., 0], {})
    two = AGENTS["ppo"]._replace(
        update_and_reward=twice, num_streams=2, mix=first_alone
    )
    env = gasil_jax.make_env("point_mass")
    AGENTS["two streams"] = two
    try:
        config = SMALL.replace(agent="two streams")
        state, _ = jax.jit(gasil_jax.make_train(env, config))(jax.random.key(0))
    finally:
        del AGENTS["two streams"]
    plain, _ = trainer("ppo")(jax.random.key(0))
    close = functools.partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-5)
    jax.tree.map(close, state.actor_critic.policy, plain.actor_critic.policy)
    first, second = state.actor_critic.values
    jax.tree.map(close, first, plain.actor_critic.values[0])
    (kernel, *_) = jax.tree.leaves(second.params)
    (other, *_) = jax.tree.leaves(first.params)
    assert not np.allclose(kernel, other)


def test_an_update_that_is_not_finite_is_as_if_it_had_not_been():
    old = {"weights": jnp.array([1.0, 2.0]), "count": jnp.int32(3)}
    fine = {"weights": jnp.array([5.0, 6.0]), "count": jnp.int32(4)}
    healthy, kept = training.keep_if_finite(fine, old)
    assert healthy and kept["weights"].tolist() == [5.0, 6.0] and kept["count"] == 4
    bad = {"weights": jnp.array([5.0, jnp.inf]), "count": jnp.int32(4)}
    healthy, kept = training.keep_if_finite(bad, old)
    assert not healthy and kept["weights"].tolist() == [1.0, 2.0] and kept["count"] == 3


def test_metrics_of_one_name_are_refused():
    merged = training.merge_metrics("ppo", {"a": jnp.int32(1)}, {"b": jnp.float32(2)})
    assert merged == {"a": 1.0, "b": 2.0}
    assert all(value.dtype == jnp.float32 for value in merged.values())
    with pytest.raises(ValueError, match="agent 'ppo' have names that others have: a"):
        training.merge_metrics("ppo", {"a": jnp.int32(1)}, {"a": jnp.float32(2)})
