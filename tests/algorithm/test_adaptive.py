"""PPO+GASIL with adaptive imitation, the bonus's forms, and the control."""

import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from test_train import SMALL

import gasil_jax
from gasil_jax import good_trajectories
from gasil_jax.imitation import adaptive, adversarial, find_agent
from gasil_jax.testing import example_context

AGENT = "ppo+gasil-adaptive"
ENV = gasil_jax.make_env("point_mass")


@functools.cache
def train(**changes):
    """Train one seed of PPO, but for the changes."""
    config = SMALL.replace(**{"agent": "ppo", **changes})
    return jax.jit(gasil_jax.make_train(ENV, config))(jax.random.key(0))


def test_mix_and_correlation_are_their_formulas():
    rng = np.random.default_rng(0)
    first, second = rng.normal(size=(2, 50, 4))
    second += 0.7 * first
    standard = lambda x: (x - x.mean()) / x.std()
    first, second = standard(first), standard(second)
    both = jnp.stack([jnp.array(first), jnp.array(second)], axis=-1)
    expected = np.corrcoef(first.ravel(), second.ravel())[0, 1]
    assert 0.3 < expected < 0.9
    np.testing.assert_allclose(adaptive.correlation(both), expected, rtol=1e-4)
    np.testing.assert_allclose(
        adaptive.mix(both, 0.3), 0.7 * first + 0.3 * second, rtol=1e-4, atol=1e-5
    )


@pytest.mark.parametrize(
    ("good", "policy", "expected"),
    [(100.0, 90.0, 0.4), (100.0, 60.0, 1.0), (100.0, 110.0, 0.0), (-8.0, -9.0, 0.5)],
)
def test_the_gap_is_in_units_of_a_quarter_of_the_buffers_return(good, policy, expected):
    result = adaptive.gap(jnp.float32(good), jnp.float32(policy))
    np.testing.assert_allclose(result, expected, rtol=1e-5)


def test_the_policys_return_follows_its_latest_whole_episodes():
    rng = np.random.default_rng(0)
    followed, has_episodes, twin = jnp.float32(0.0), jnp.bool_(False), None
    for _ in range(6):
        returns = rng.normal(size=(5, 3))
        completed = rng.random((5, 3)) < 0.2
        returns[rng.random((5, 3)) < 0.2] = np.nan  # of faulty episodes
        batch = SimpleNamespace(
            completed=jnp.array(completed), discounted_return=jnp.array(returns)
        )
        followed, has_episodes = adaptive.follow_return(followed, has_episodes, batch)
        counted = returns[completed & np.isfinite(returns)]
        if len(counted):
            past = 0.0 if twin is None else 0.9 ** len(counted)
            twin = past * (twin or 0.0) + (1 - past) * counted.mean()
        if twin is not None:
            np.testing.assert_allclose(followed, twin, rtol=1e-4)
    assert has_episodes and twin is not None


def test_without_weight_it_is_ppo():
    (state, _), (plain, _) = train(agent=AGENT, imitation_weight=0.0), train()
    close = functools.partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-5)
    jax.tree.map(close, state.actor_critic.policy, plain.actor_critic.policy)


@functools.cache
def context_and_state():
    """The context of the first iteration, and a state of adaptive imitation."""
    config, key = SMALL.replace(agent=AGENT), jax.random.key(0)
    context = jax.jit(lambda key: example_context(ENV, config, key))(key)
    state = find_agent(AGENT).init(key, config, ENV.observation_size, ENV.action_size)
    return context, state


@pytest.mark.parametrize("rule", adaptive.RULES)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_rule_is_the_product_of_the_factors_in_its_name(rule, sign):
    context, state = context_and_state()
    context = context.replace(config=context.config.replace(imitation_rule=rule))
    good_return = good_trajectories.mean_return(context.good_trajectories)
    state = state.replace(policy_return=good_return - 0.1 * jnp.abs(good_return))
    rewards, noise = np.random.default_rng(0).normal(size=(2, 64, 4))
    streams = jnp.stack([rewards, 0.6 * sign * rewards + 0.8 * noise], axis=-1)
    advantage, metrics = find_agent(AGENT).mix(state, streams, context)
    agreement = np.mean(streams[..., 0] * streams[..., 1])
    assert sign * agreement > 0.3
    expected = 0.7
    if rule in ("agreement", "both"):
        expected *= np.maximum(agreement, 0.0)
    if rule in ("gap", "both"):
        expected *= 0.4
    np.testing.assert_allclose(metrics["imitation_weight"], expected, rtol=1e-5)
    mixed = (1 - expected) * streams[..., 0] + expected * streams[..., 1]
    np.testing.assert_allclose(advantage, mixed, rtol=1e-4, atol=1e-5)


def twin(name, logit):
    """The bonus from D itself, in double precision."""
    d = 1 / (1 + np.exp(-logit))
    ratio = np.log(1 - d) - np.log(d)
    return {
        "softplus": -np.log(d),
        "logit": ratio,
        "dail": 0.5 * (1 - d) * (np.tanh(ratio) + 1),
        "centered": -np.log(d) - np.mean(-np.log(d)),
    }[name]


@pytest.mark.parametrize("name", adversarial.BONUSES)
def test_a_form_of_the_bonus_is_its_formula_and_pays_more_for_good_pairs(name):
    logit = np.linspace(-6.0, 6.0, 25)
    result = adversarial.BONUSES[name](jnp.asarray(logit, jnp.float32))
    np.testing.assert_allclose(result, twin(name, logit), rtol=1e-3, atol=1e-5)
    # A low logit means: not from the policy, like the buffer.
    assert np.all(np.diff(result) < 0)


@pytest.mark.parametrize(
    ("name", "pays"),
    [("softplus", True), ("dail", True), ("logit", False), ("centered", False)],
)
def test_which_bonus_pays_for_staying_up(name, pays):
    """Where D tells nothing apart: is a step more worth something?"""
    clueless = adversarial.BONUSES[name](jnp.zeros(8))
    assert np.all(clueless > 0.2) if pays else np.all(clueless == 0.0)


def test_the_control_is_paid_for_every_step():
    (without, _), (plain, _) = train(agent="ppo+bonus", alpha=0.0), train()
    close = functools.partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-5)
    jax.tree.map(close, without.actor_critic, plain.actor_critic)
    config, key = SMALL.replace(agent="ppo+bonus", alpha=0.7), jax.random.key(0)
    context = jax.jit(lambda key: example_context(ENV, config, key))(key)
    _, rewards, _ = find_agent("ppo+bonus").update_and_reward((), context, key)
    np.testing.assert_allclose(rewards - context.rollout.reward, 0.7, rtol=1e-5)


@pytest.mark.parametrize(("agent", "share"), [("ppo+gasil", 1.0), ("gasil", 0.0)])
def test_the_bonus_is_added_to_the_reward_or_stands_in_its_place(agent, share):
    config = SMALL.replace(agent=agent, alpha=0.7)

    @jax.jit
    def first(key):
        context = example_context(ENV, config, key)
        state = gasil_jax.init(ENV, config, key).imitation
        _, rewards, _ = find_agent(agent).update_and_reward(state, context, key)
        _, bonus, _ = adversarial.update_and_score(state, context, key)
        return context.good_trajectories.size, context.rollout.reward, bonus, rewards

    size, reward, bonus, rewards = first(jax.random.key(0))
    assert size > 0 and bonus.std() > 0.01
    expected = share * reward + 0.7 * bonus
    np.testing.assert_allclose(rewards, expected, rtol=1e-5, atol=1e-6)


def test_a_form_that_does_not_exist_is_refused():
    with pytest.raises(ValueError, match=r"bonus 'softmax' is unknown: .*softplus"):
        gasil_jax.make_train(ENV, SMALL.replace(bonus="softmax"))
    with pytest.raises(ValueError, match=r"imitation_rule 'bot' is unknown: .*'both'"):
        gasil_jax.make_train(ENV, SMALL.replace(imitation_rule="bot"))


@functools.cache
def first_update(**changes):
    """The discriminator after an iteration of GASIL, (parameters,), and the buffer."""
    several = {"agent": "gasil", "batch_steps": 1024, "buffer_steps": 300}
    config = SMALL.replace(**several, **changes)

    @jax.jit
    def first(key):
        context = example_context(ENV, config, key)
        state = gasil_jax.init(ENV, config, key).imitation
        state, *_ = find_agent("gasil").update_and_reward(state, context, key)
        return ravel_pytree(state.params)[0], context.good_trajectories

    return first(jax.random.key(0))


@pytest.mark.parametrize(
    "change",
    [
        {"discriminator_gradient_penalty": 10.0},
        {"discriminator_normalizes_actions": True},
        {"buffer_episodes": 1},
        {"buffer_discounts": False},
        {"sample_by_return": True},
    ],
)
def test_an_option_of_buffer_or_discriminator_changes_what_is_learned(change):
    (plain, before), (params, buffer) = first_update(), first_update(**change)
    assert np.all(np.isfinite(params))
    assert not np.allclose(plain, params, atol=1e-7)
    if "buffer_episodes" in change:
        assert buffer.size == 50 < before.size
    if "buffer_discounts" in change:
        mean_return = good_trajectories.mean_return
        assert mean_return(buffer) > 1.02 * mean_return(before)
