"""Every agent learns, looks at its own numbers, and does not depend on reward units.

All checks of an agent share one compiled iteration of two members. Their random keys,
hyperparameters and reward units are data.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs import Wrapper

import gasil_jax
from gasil_jax import normalization
from gasil_jax.config import traced_names
from gasil_jax.distributions import GAUSSIAN
from gasil_jax.networks import GaussianPolicy

ENV = gasil_jax.make_env("point_mass")
CONFIG = gasil_jax.Config(
    total_steps=40 * 2048, num_epochs=5, hidden_sizes=(64,), learning_rate=6e-4
)
DISCRIMINATOR = {
    "discriminator_hidden_sizes": (64,),
    "discriminator_updates": 20,
    "discriminator_learning_rate": 3e-4,
}
# GAIL needs an expert: test_gail.py.
SELF_TAUGHT = (
    gasil_jax.PPO(),
    # A constant bonus as large as the normalized reward drowns it.
    gasil_jax.PPOBonus(alpha=0.1),
    # The best two episodes, which differ from the others.
    gasil_jax.PPOBC(buffer_steps=100),
    gasil_jax.PPONovelty(),
    gasil_jax.PPOBCNovelty(buffer_steps=100),
    gasil_jax.PPOSIL(),
    gasil_jax.GASIL(alpha=1.0, **DISCRIMINATOR),
    gasil_jax.PPOGASIL(alpha=1.0, **DISCRIMINATOR),
    gasil_jax.PPOGASILAdaptive(**DISCRIMINATOR),
)
ALGORITHMS = {
    agent.name: gasil_jax.Algorithm(agent, (gasil_jax.Normalize(),), CONFIG)
    for agent in SELF_TAUGHT
}


def each(agents):
    """Parameters of a test; one worker for each agent, so that it is compiled once."""
    return [
        pytest.param(agent.name, marks=pytest.mark.xdist_group(f"agent {agent.name}"))
        for agent in agents
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
    algorithm = ALGORITHMS[agent]
    two = jax.ShapeDtypeStruct((2,), jnp.float32)
    keys = jax.eval_shape(jax.vmap(jax.random.key), jnp.arange(2))
    init = jax.vmap(functools.partial(gasil_jax.init, ENV, algorithm))
    numbers = dict.fromkeys(algorithm.hyperparameters, two)
    init = jax.jit(init).lower(keys, numbers).compile()
    iterate = jax.vmap(
        lambda state, factor: gasil_jax.iterate(Scaled(ENV, factor), algorithm, state)
    )
    return init, jax.jit(iterate).lower(init.out_info, two).compile()


def train(agent, iterations, *, changes=({}, {}), units=(1, 1), seeds=(0, 0)):
    """Train two members; return their last states, and metrics (2, iterations)."""
    init, iterate = programs(agent)
    members = [ALGORITHMS[agent].replace(**x).hyperparameters for x in changes]
    stacked = jax.tree.map(lambda *x: np.array(x, np.float32), *members)
    state = init(jax.vmap(jax.random.key)(jnp.array(seeds)), stacked)
    rows = []
    for _ in range(iterations):
        state, metrics = iterate(state, np.array(units, np.float32))
        rows.append(metrics)
    return state, jax.tree.map(lambda *x: np.stack(x, axis=1), *rows)


def test_every_agent_but_the_taught_one_is_tested():
    assert [*ALGORITHMS, "gail"] == list(gasil_jax.agents())


@pytest.mark.parametrize("agent", each(SELF_TAUGHT))
def test_it_learns_on_the_point_mass(agent):
    _, metrics = train(agent, 18, seeds=(0, 1))
    returns = metrics["episode_return"]
    # From about 5 at random, a blue object now and then; both and a green one are 20.
    assert np.all(returns[:, 0] < 8.0)
    assert np.all(returns[:, -3:].mean(1) > 15.0)


def halved(agent, names):
    """Changes that halve an agent's numbers."""
    return {name: 0.5 * ALGORITHMS[agent].hyperparameters[name] for name in names}


@pytest.mark.parametrize("agent", each(x for x in SELF_TAUGHT if traced_names(x)))
def test_an_agent_looks_at_each_of_its_numbers(agent):
    for name in traced_names(ALGORITHMS[agent].agent):
        state, _ = train(agent, 2, changes=({}, halved(agent, [name])))
        kernel = np.asarray(jax.tree.leaves(state.actor_critic)[0])
        assert (kernel[0] != kernel[1]).any(), name


@pytest.mark.parametrize("agent", each(SELF_TAUGHT))
def test_the_unit_of_the_reward_does_not_matter(agent):
    # Without normalization it does: to a bonus beside it, and to the value's loss.
    _, metrics = train(agent, 3, units=(1, 1024))
    close = functools.partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-5)
    assert np.all(np.isfinite(metrics["reward_scale"]))
    for name in ("policy_loss", "value_loss", "entropy", "bonus", "sil_fraction"):
        if name in metrics:
            close(metrics[name][1], metrics[name][0], err_msg=name)
    # The buffer holds the environment's own returns.
    for name in metrics.keys() & {"reward_scale", "good_return"}:
        usual, scaled = metrics[name]
        np.testing.assert_allclose(scaled, 1024.0 * usual, rtol=1e-4, err_msg=name)


@pytest.mark.xdist_group("agent ppo+gasil")
def test_vmap_over_every_hyperparameter_equals_single_runs():
    algorithm = ALGORITHMS["ppo+gasil"]
    half = halved("ppo+gasil", algorithm.hyperparameters)
    _, together = train("ppo+gasil", 2, changes=({}, half))
    init = jax.jit(functools.partial(gasil_jax.init, ENV, algorithm))
    iterate = jax.jit(functools.partial(gasil_jax.iterate, ENV, algorithm))
    for i, hyperparameters in enumerate((algorithm.hyperparameters, half)):
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


class TwoStreams(gasil_jax.Agent):
    """PPO on the first of two streams."""

    num_streams = 2

    def update_and_reward(self, state, context, key):
        reward = context.rollout.reward
        return state, jnp.stack([reward, -3.0 * reward], axis=-1), {}

    def mix(self, state, advantages, context):
        return advantages[..., 0], {}


@pytest.mark.xdist_group("agent ppo")
def test_two_streams_of_the_same_reward_are_that_reward():
    """Each stream has its own value; with one of them at weight 0 it is plain PPO."""
    algorithm = dataclasses.replace(ALGORITHMS["ppo"], agent=TwoStreams())
    init = jax.jit(functools.partial(gasil_jax.init, ENV, algorithm))
    iterate = jax.jit(functools.partial(gasil_jax.iterate, ENV, algorithm))
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
    fast = {"learning_rate": 1e-3}
    strong, without = (
        {**fast, "behavior_cloning_coefficient": weight} for weight in (10.0, 0.0)
    )
    # Only the cloning, which comes last in the iteration, differs.
    states, _ = train("ppo+bc", 1, changes=(strong, without))
    good = gasil_jax.member(states.agent, 0)
    np.testing.assert_array_equal(states.agent.size, 100)
    np.testing.assert_array_equal(states.agent.action[1], good.action)
    normalizer = normalization.init(ENV.observation_size)
    observation = normalization.normalize(normalizer, good.observation[:100])
    network = GaussianPolicy(CONFIG.hidden_sizes, ENV.action_size)
    losses = []
    for i in range(2):
        params = gasil_jax.member(states, i).actor_critic.policy.params
        gaussian = network.apply(params, observation)
        losses.append(-float(jnp.mean(GAUSSIAN.log_prob(gaussian, good.action[:100]))))
    print("losses:", losses)
    assert losses[0] < losses[1] - 0.01
    # Without weight it is PPO. Adam's momentum still acts on the policy, so that only
    # the value, which cloning leaves alone, is equal.
    plain, _ = train("ppo", 1, changes=(fast, fast))
    jax.tree.map(
        functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6),
        gasil_jax.member(states.actor_critic.params["values"], 1),
        gasil_jax.member(plain.actor_critic.params["values"], 1),
    )
