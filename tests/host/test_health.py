"""Numbers that are not finite harm one step, one update, and nobody else."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import test_members
from brax.envs import State

import gasil_jax
from gasil_envs import wrappers
from gasil_jax import config, run
from gasil_jax.host.members import make_members

SMALL = test_members.SMALL.replace(total_steps=4 * 128, buffer_steps=300)


def as_arrays(tree):
    plain = lambda x: (
        jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    )
    return [np.asarray(plain(x)) for x in jax.tree.leaves(tree)]


def train(members, advance, states, iterations):
    collected = []
    for i in range(iterations):
        states, metrics = members.train(advance, states, i, 1)
        collected.append(metrics)
    joined = {
        name: np.concatenate([m[name] for m in collected], axis=1)
        for name in collected[0]
    }
    return members.trim(states), joined


@pytest.mark.parametrize("agent", ["ppo+gasil", "ppo+sil"])
def test_a_nan_in_one_environment_of_one_seed(agent):
    env = gasil_jax.make_env("point_mass", reward_delay=7)
    # An episode that is cut short has no return either.
    config = SMALL.replace(agent=agent, stagger_episodes=False)
    members = make_members(env, config, [3, 4, 5, 6])
    states, advance = members.compile()
    clean, clean_metrics = train(members, advance, states, 3)

    states = jax.tree.map(np.asarray, members.init().environments.state.pipeline_state)
    hurt = jax.tree.map(
        lambda x: (
            x.at[1, 2].set(jnp.nan) if jnp.issubdtype(x.dtype, jnp.floating) else x
        ),
        jax.tree.map(jnp.asarray, states),
    )
    start = members.init()
    environments = start.environments
    start = start.replace(
        environments=environments.replace(
            state=environments.state.replace(pipeline_state=hurt)
        )
    )
    after, metrics = train(members, advance, jax.device_put(start, members.sharding), 3)

    # One step of seed 4 is counted, and its episode is over with it.
    np.testing.assert_array_equal(metrics["faulty_steps"].sum(axis=1), [0, 1, 0, 0])
    assert metrics["skipped_updates"].sum() == 0
    learned = (after.actor_critic.params, after.imitation, after.normalizer)
    for leaf in as_arrays(learned):
        assert np.isfinite(leaf).all()
    filled = int(after.good_trajectories.size[1])
    for leaf in (after.good_trajectories.observation, after.good_trajectories.return_):
        assert np.isfinite(leaf[1, :filled]).all()
    # Its return is unknown.
    assert np.isnan(after.history.reward).sum(axis=(1, 2)).tolist() == [0, 1, 0, 0]
    # The others are what they were, bit for bit.
    others = np.array([0, 2, 3])
    for left, right in zip(as_arrays(after), as_arrays(clean), strict=True):
        np.testing.assert_array_equal(left[others], right[others])
    for name in metrics:
        np.testing.assert_array_equal(
            metrics[name][others], clean_metrics[name][others], err_msg=name
        )


def test_an_update_that_is_not_finite_is_skipped_and_flagged():
    env = gasil_jax.make_env("point_mass")
    usual = config.Hyperparameters()
    wild = usual.replace(learning_rate=float("inf"))
    members = make_members(env, SMALL, [3, 4, 5, 6], [usual, wild, usual, usual])
    states, advance = members.compile()
    before = as_arrays(states.actor_critic)
    after, metrics = train(members, advance, states, 2)
    np.testing.assert_array_equal(metrics["skipped_updates"].sum(axis=1), [0, 2, 0, 0])
    for left, right in zip(as_arrays(after.actor_critic), before, strict=True):
        np.testing.assert_array_equal(left[1], right[1])
    calm = make_members(env, SMALL, [3, 4, 5, 6], [usual] * 4)
    states, _ = calm.compile()
    expected, _ = train(calm, advance, states, 2)
    others = np.array([0, 2, 3])
    for left, right in zip(
        as_arrays(after.actor_critic), as_arrays(expected.actor_critic)
    ):
        np.testing.assert_array_equal(left[others], right[others])


def test_an_unhealthy_seed_is_in_the_summary_with_a_warning(tmp_path, capsys):
    out = tmp_path / "out"
    arguments = (
        "--env",
        "point_mass",
        "--seeds",
        "2",
        "--total-steps",
        "256",
        "--batch-steps",
        "128",
        "--num-envs",
        "4",
        "--minibatch-size",
        "32",
        "--hidden-sizes",
        "8",
        "--num-epochs",
        "1",
        "--learning-rate",
        "1e38",
    )
    assert run.main([*arguments, "--out", str(out)]) == 0
    assert "warning: numbers that were not finite in seeds [0, 1]" in (
        capsys.readouterr().err
    )
    assert (
        '"unhealthy_seeds": [\n    0,\n    1\n  ]' in (out / "summary.json").read_text()
    )


class Fragile:
    """A line whose reward, and nothing else, is NaN beyond a certain position."""

    observation_size, action_size, episode_length = 1, 1, 20

    def reset(self, key):
        position = jax.random.uniform(key, (1,), minval=-0.5, maxval=0.5)
        return State(position, position, jnp.float32(0), jnp.float32(0))

    def step(self, state, action):
        position = state.pipeline_state + 0.1 * action
        reward = jnp.where(position[0] > 0.6, jnp.nan, -(position[0] ** 2))
        return state.replace(pipeline_state=position, obs=position, reward=reward)


@pytest.mark.parametrize("limit", [20, 15])
def test_a_reward_that_is_held_back_is_looked_at_too(limit):
    env = wrappers.RewardDelay(wrappers.EpisodeLimit(Fragile(), 20), 10)
    small = SMALL.replace(max_episode_steps=limit)
    _, metrics = jax.jit(gasil_jax.make_train(env, small))(jax.random.key(0))
    assert metrics["faulty_steps"].sum() > 0
    assert metrics["skipped_updates"].sum() == 0
    ended = metrics["episodes"] > 0
    assert ended.any() and np.isfinite(metrics["episode_return"][ended]).all()
