"""Every agent learns, looks at its own fields, and does not depend on reward units.

All checks of an agent share one compiled iteration of two members. Their random keys,
hyperparameters and reward units are data.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs import Wrapper

import gasil_jax
from gasil_jax import normalization
from gasil_jax.imitation import AGENTS, behavior_cloning
from gasil_jax.networks import Policy

ENV = gasil_jax.make_env("point_mass")
CONFIG = gasil_jax.Config(
    total_steps=40 * 2048,
    normalize_rewards=True,
    # Half the epochs take half the time, and learn as fast at twice the step size.
    num_epochs=5,
    hidden_sizes=(64,),
    discriminator_hidden_sizes=(64,),
    hyperparameters=gasil_jax.Hyperparameters(
        learning_rate=6e-4,
        alpha=1.0,
        discriminator_updates=20,
        discriminator_learning_rate=3e-4,
    ),
)
PLAIN = CONFIG.hyperparameters
# GAIL needs an expert: test_gail.py.
SELF_TAUGHT = [name for name in gasil_jax.agents() if name != "gail"]
# One worker for each agent, so that it is compiled once.
EACH_AGENT = [
    pytest.param(name, marks=pytest.mark.xdist_group(f"agent {name}"))
    for name in SELF_TAUGHT
]


class Scaled(Wrapper):
    """Multiplies the rewards by a factor, which may be traced."""

    def __init__(self, env, factor):
        super().__init__(env)
        self.factor = factor

    def step(self, state, action):
        state = self.env.step(state, action)
        return state.replace(reward=self.factor * state.reward)


@functools.cache
def programs(agent):
    """Compiled functions of two members: their first states, and an iteration."""
    config = CONFIG.replace(agent=agent)
    two = jax.ShapeDtypeStruct((2,), jnp.float32)
    keys = jax.eval_shape(jax.vmap(jax.random.key), jnp.arange(2))
    init = jax.vmap(functools.partial(gasil_jax.init, ENV, config))
    init = jax.jit(init).lower(keys, jax.tree.map(lambda _: two, PLAIN)).compile()
    iterate = jax.vmap(
        lambda state, factor: gasil_jax.iterate(Scaled(ENV, factor), config, state)
    )
    return init, jax.jit(iterate).lower(init.out_info, two).compile()


def train(
    agent, iterations, *, hyperparameters=(PLAIN, PLAIN), units=(1, 1), seeds=(0, 0)
):
    """Train two members; return their last states, and metrics (2, iterations)."""
    init, iterate = programs(agent)
    stacked = jax.tree.map(lambda *x: np.array(x, np.float32), *hyperparameters)
    state = init(jax.vmap(jax.random.key)(jnp.array(seeds)), stacked)
    rows = []
    for _ in range(iterations):
        state, metrics = iterate(state, np.array(units, np.float32))
        rows.append(metrics)
    return state, jax.tree.map(lambda *x: np.stack(x, axis=1), *rows)


@pytest.mark.parametrize("agent", EACH_AGENT)
def test_it_learns_on_the_point_mass(agent):
    # A constant bonus as large as the normalized reward drowns it.
    point = PLAIN.replace(alpha=0.1) if agent == "ppo+bonus" else PLAIN
    _, metrics = train(agent, 18, seeds=(0, 1), hyperparameters=(point, point))
    returns = metrics["episode_return"]
    # From about 5 at random, a blue object now and then; both and a green one are 20.
    assert np.all(returns[:, 0] < 8.0)
    assert np.all(returns[:, -3:].mean(1) > 15.0)


@pytest.mark.parametrize("agent", EACH_AGENT)
def test_an_agent_looks_at_the_fields_that_it_says_and_at_no_others(agent):
    fields = {name for each in AGENTS.values() for name in each.fields}
    fields = {name for name in fields if hasattr(PLAIN, name)}
    used = fields.intersection(AGENTS[agent].fields)

    def differs(names):
        changed = PLAIN.replace(**{name: getattr(PLAIN, name) / 2 for name in names})
        state, _ = train(agent, 2, hyperparameters=(PLAIN, changed))
        kernel = np.asarray(jax.tree.leaves(state.actor_critic)[0])
        return (kernel[0] != kernel[1]).any()

    assert not differs(fields - used), fields - used
    assert [name for name in sorted(used) if differs([name])] == sorted(used)


@pytest.mark.parametrize("agent", EACH_AGENT)
def test_the_unit_of_the_reward_does_not_matter(agent):
    # Without normalization it does: to a bonus beside it, and to the value's loss.
    _, metrics = train(agent, 3, units=(1, 1024))
    close = functools.partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-5)
    assert np.all(np.isfinite(metrics["reward_scale"]))
    for name in ("policy_loss", "value_loss", "entropy", "bonus", "sil_fraction"):
        if name in metrics:
            close(metrics[name][1], metrics[name][0], err_msg=name)
    # The buffer holds the environment's own returns.
    for name in ("reward_scale", "good_return"):
        usual, scaled = metrics[name]
        np.testing.assert_allclose(scaled, 1024.0 * usual, rtol=1e-4, err_msg=name)


@pytest.mark.xdist_group("agent ppo+gasil")
def test_vmap_over_every_hyperparameter_equals_single_runs():
    # Counts may be smaller than those of the config, which decide the shapes.
    counts = {"buffer_steps": 500, "discriminator_updates": 10}
    plain = PLAIN.replace(**counts)
    half = jax.tree.map(lambda x: 0.5 * x, PLAIN).replace(**counts)
    _, together = train("ppo+gasil", 2, hyperparameters=(plain, half))
    config = CONFIG.replace(agent="ppo+gasil", **counts)
    init = jax.jit(functools.partial(gasil_jax.init, ENV, config))
    iterate = jax.jit(functools.partial(gasil_jax.iterate, ENV, config))
    for i, hyperparameters in enumerate((plain, half)):
        state = init(jax.random.key(0), hyperparameters)
        for iteration in range(2):
            state, metrics = iterate(state)
            for name in ("bonus", "policy_loss", "value_loss", "good_steps"):
                np.testing.assert_allclose(
                    together[name][i, iteration],
                    metrics[name],
                    rtol=1e-3,
                    atol=1e-5,
                    err_msg=name,
                )
    assert np.all(together["bonus"][0] > together["bonus"][1])


@pytest.mark.xdist_group("agent ppo")
def test_two_streams_of_the_same_reward_are_that_reward(monkeypatch):
    """Each stream has its own value; with one of them at weight 0 it is plain PPO."""

    def twice(state, context, key):
        reward = context.rollout.reward
        return state, jnp.stack([reward, -3.0 * reward], axis=-1), {}

    first_alone = lambda state, advantages, context: (advantages[..., 0], {})
    two = AGENTS["ppo"]._replace(
        update_and_reward=twice, num_streams=2, mix=first_alone
    )
    monkeypatch.setitem(AGENTS, "two streams", two)
    config = CONFIG.replace(agent="two streams")
    init = jax.jit(functools.partial(gasil_jax.init, ENV, config))
    iterate = jax.jit(functools.partial(gasil_jax.iterate, ENV, config))
    state, _ = iterate(init(jax.random.key(0)))
    plain = gasil_jax.member(train("ppo", 1)[0], 0).actor_critic
    close = functools.partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-4)
    jax.tree.map(close, state.actor_critic.policy.params, plain.policy.params)
    first, second = state.actor_critic.values
    jax.tree.map(close, first.params, plain.values[0].params)
    (kernel, *_) = jax.tree.leaves(second.params)
    (other, *_) = jax.tree.leaves(first.params)
    assert not np.allclose(kernel, other)


@pytest.mark.xdist_group("agent ppo+bc")
def test_cloning_makes_the_good_steps_likelier():
    # Large steps, on the best two episodes, which differ from the others.
    fast = PLAIN.replace(learning_rate=1e-3, buffer_steps=100)
    strong, without = (
        fast.replace(behavior_cloning_coefficient=weight) for weight in (10.0, 0.0)
    )
    # Only the cloning, which comes last in the iteration, differs.
    states, _ = train("ppo+bc", 1, hyperparameters=(strong, without))
    good = gasil_jax.member(states.good_trajectories, 0)
    np.testing.assert_array_equal(states.good_trajectories.size, 100)
    np.testing.assert_array_equal(states.good_trajectories.action[1], good.action)
    normalizer = normalization.init(ENV.observation_size)
    observation = normalization.normalize(normalizer, good.observation[:100])
    network = Policy(CONFIG.hidden_sizes, ENV.action_size)
    losses = []
    for i in range(2):
        params = gasil_jax.member(states, i).actor_critic.policy.params
        gaussian = network.apply(params, observation)
        losses.append(float(behavior_cloning.loss(*gaussian, good.action[:100])))
    print("losses:", losses)
    assert losses[0] < losses[1] - 0.01
    # Without weight it is PPO. Adam's momentum still acts on the policy, so that only
    # the value, which cloning leaves alone, is equal.
    plain, _ = train("ppo", 1, hyperparameters=(fast, fast))
    jax.tree.map(
        functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6),
        gasil_jax.member(states.actor_critic.params["values"], 1),
        gasil_jax.member(plain.actor_critic.params["values"], 1),
    )
