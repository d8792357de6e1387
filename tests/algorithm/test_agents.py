"""Every agent learns, looks at its own numbers, and does not depend on reward units.

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
from gasil_jax.config import traced_names
from gasil_jax.distributions import GAUSSIAN
from gasil_jax.networks import GaussianPolicy

ENV = gasil_jax.make_env("point_mass")
CONFIG = gasil_jax.Config(
    total_steps=40 * 2048, num_epochs=5, hidden_sizes=(64,), learning_rate=6e-4
)
DISCRIMINATOR = {"discriminator_updates": 20, "discriminator_learning_rate": 3e-4}
DISCRIMINATOR |= {"discriminator_hidden_sizes": (64,)}
# GAIL needs an expert: test_discrete.py.
SELF_TAUGHT = (
    gasil_jax.PPO(),
    # The best two episodes, which differ from the others.
    gasil_jax.PPOBC(buffer_steps=100),
    gasil_jax.PPOBCNovelty(buffer_steps=100),
    gasil_jax.PPOGASILNovelty(**DISCRIMINATOR),
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
        lambda x, factor: gasil_jax.train_step(Scaled(ENV, factor), algorithm, x)
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


def close(**tolerance):
    return functools.partial(np.testing.assert_allclose, **tolerance)


@pytest.mark.parametrize("agent", each(SELF_TAUGHT))
def test_it_learns_on_the_point_mass(agent):
    # What imitates alone, or as strongly, takes longer.
    iterations = 18 if agent in ("gasil", "ppo+gasil") else 10
    _, metrics = train(agent, iterations, seeds=(0, 1))
    returns = metrics["episode_return"]
    # From about 5 at random, a blue object now and then; both and a green one are 20.
    assert np.all(returns[:, 0] < 8.0)
    assert np.all(returns[:, -3:].mean(1) > 15.0)


@pytest.mark.parametrize("agent", each(x for x in SELF_TAUGHT if traced_names(x)))
def test_an_agent_looks_at_each_of_its_numbers(agent):
    algorithm = ALGORITHMS[agent]
    for name in traced_names(algorithm.agent):
        half = {name: 0.5 * algorithm.hyperparameters[name]}
        state, _ = train(agent, 2, changes=({}, half))
        kernel = np.asarray(jax.tree.leaves(state.actor_critic)[0])
        assert (kernel[0] != kernel[1]).any(), name


@pytest.mark.parametrize("agent", each(SELF_TAUGHT))
def test_the_unit_of_the_reward_does_not_matter(agent):
    # Without normalization it does: to a bonus beside it, and to the value's loss.
    _, metrics = train(agent, 3, units=(1, 1024))
    assert np.all(np.isfinite(metrics["reward_scale"]))
    for name in ("policy_loss", "value_loss", "entropy", "bonus", "sil_fraction"):
        if name in metrics:
            usual, scaled = metrics[name]
            close(rtol=1e-3, atol=1e-5)(scaled, usual, err_msg=name)
    # The buffer holds the environment's own returns.
    for name in metrics.keys() & {"reward_scale", "good_return"}:
        usual, scaled = metrics[name]
        np.testing.assert_allclose(scaled, 1024.0 * usual, rtol=1e-4, err_msg=name)


@pytest.mark.xdist_group("agent ppo+gasil-adaptive")
def test_each_stream_has_its_own_value_and_without_weight_it_is_ppo():
    without = {"imitation_weight": 0.0}
    states, _ = train("ppo+gasil-adaptive", 1, changes=(without, {}))
    plain = train("ppo", 1)[0].actor_critic
    member = lambda tree: jax.tree.map(lambda x: x[0], tree.params)
    own, expected = states.actor_critic, member(plain.policy)
    jax.tree.map(close(rtol=1e-3, atol=1e-4), member(own.policy), expected)
    first, second = map(member, own.values)
    jax.tree.map(close(rtol=1e-3, atol=1e-4), first, member(plain.values[0]))
    assert not np.allclose(jax.tree.leaves(first)[0], jax.tree.leaves(second)[0])
    # With weight it is another one.
    (kernel, *_) = jax.tree.leaves(own.policy.params)
    assert not np.allclose(kernel[0], kernel[1], atol=1e-3)


@pytest.mark.xdist_group("agent ppo+bc")
def test_cloning_makes_the_good_steps_likelier():
    fast = {"learning_rate": 1e-3}
    strong, without = (
        {**fast, "behavior_cloning_coefficient": weight} for weight in (10.0, 0.0)
    )
    # Only the cloning, which comes last in the iteration, differs.
    states, _ = train("ppo+bc", 1, changes=(strong, without))
    buffers = states.agent.buffer
    good = gasil_jax.member(buffers, 0)
    np.testing.assert_array_equal(buffers.size, 100)
    np.testing.assert_array_equal(buffers.action[1], good.action)
    normalizer = normalization.init(ENV.observation_size)
    observation = normalization.normalize(normalizer, good.observation[:100])
    network = GaussianPolicy(CONFIG.hidden_sizes, ENV.action_size)
    losses = []
    for i in range(2):
        params = gasil_jax.member(states, i).actor_critic.policy.params
        gaussian = network.apply(params, observation)
        losses.append(-float(jnp.mean(GAUSSIAN.log_prob(gaussian, good.action[:100]))))
    assert losses[0] < losses[1] - 0.01
    # Without weight it is PPO. Adam's momentum still acts on the policy, so that only
    # the value, which cloning leaves alone, is equal.
    plain, _ = train("ppo", 1, changes=(fast, fast))
    jax.tree.map(
        close(rtol=1e-5, atol=1e-6),
        gasil_jax.member(states.actor_critic.params["values"], 1),
        gasil_jax.member(plain.actor_critic.params["values"], 1),
    )
