"""Generative adversarial self-imitation (paper, section 4).

Signs are the paper's. D(s, a) is the probability that the pair comes from the policy
and not from the buffer; the discriminator ascends

    E_pi[log D(s, a)] + E_B[log(1 - D(s, a))]

and the policy receives the bonus -alpha log D(s, a) >= 0, which is larger for pairs
that look like the buffer's. Everything is computed from the logit l of D:
log D = -softplus(-l), log(1 - D) = -softplus(l). The bonus is never negative, as in the
paper, and therefore favours long episodes (survival bias).

While the buffer is empty, D does not train and the bonus is 0. GAIL is the same method
with a fixed set of expert pairs instead of the buffer.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from gasil_jax import good_trajectories, learner, normalization
from gasil_jax.config import Config, Hyperparameters
from gasil_jax.imitation import expert
from gasil_jax.imitation.interface import Context, Imitation, Metrics, leave_policy
from gasil_jax.learner import Learner
from gasil_jax.networks import Discriminator


def softplus_bonus(logit: jax.Array) -> jax.Array:
    """Return -log D (paper, section 4.3): never negative, so it pays for staying up."""
    return jax.nn.softplus(-logit)


def logit_bonus(logit: jax.Array) -> jax.Array:
    """Return log(1 - D) - log D (AIRL, Fu et al. 2018): of both signs.

    It is 0 where D cannot tell, and so neither pays for staying up nor for ending.
    """
    return -logit


def dail_bonus(logit: jax.Array) -> jax.Array:
    """Return sigmoid(x) (tanh(x) + 1) / 2 of x = -logit (DAIL, arXiv:2510.00922).

    It is between 0 and 1, so it pays for staying up, but less for pairs that are
    clearly the policy's own.
    """
    return 0.5 * jax.nn.sigmoid(-logit) * (jnp.tanh(-logit) + 1.0)


def centered_bonus(logit: jax.Array) -> jax.Array:
    """Return -log D minus its mean over the batch: of both signs.

    A step like all others gets 0, so on the whole it does not pay for staying up.
    """
    softplus = softplus_bonus(logit)
    return softplus - jnp.mean(softplus)


#: The forms of the bonus, functions of the logit of D on a batch, (time, env).
BONUSES: Mapping[str, Callable[[jax.Array], jax.Array]] = {
    "softplus": softplus_bonus,
    "logit": logit_bonus,
    "dail": dail_bonus,
    "centered": centered_bonus,
}


def loss(
    policy_logit: jax.Array,
    good_logit: jax.Array,
    entropy_coefficient: jax.Array | float,
) -> tuple[jax.Array, Metrics]:
    """Return the discriminator's loss: minus the paper's objective (equation 10).

    Args:
      policy_logit: (minibatch,), logits of D on the policy's pairs.
      good_logit: (minibatch,), logits of D on the buffer's pairs.
      entropy_coefficient: weight of the entropy of D's output on all pairs, which
        keeps D from becoming certain (OpenAI baselines' GAIL).

    Returns:
      The loss, (), and its parts as metrics.
    """
    log_likelihood = -jnp.mean(jax.nn.softplus(-policy_logit)) - jnp.mean(
        jax.nn.softplus(good_logit)
    )
    logits = jnp.concatenate([policy_logit, good_logit])
    probability = jax.nn.sigmoid(logits)
    entropy = jnp.mean(jax.nn.softplus(-logits) + (1.0 - probability) * logits)
    metrics = {
        "discriminator_loss": -log_likelihood,
        "discriminator_policy_probability": jnp.mean(jax.nn.sigmoid(policy_logit)),
        "discriminator_good_probability": jnp.mean(jax.nn.sigmoid(good_logit)),
    }
    return -log_likelihood - entropy_coefficient * entropy, metrics


def _network(config: Config) -> Any:
    # Typed as Any because Flax declares that `apply` may also return variables.
    return Discriminator(config.discriminator_hidden_sizes)


def _optimizer() -> optax.GradientTransformation:
    # One vector of parameters is faster, see `ppo.optimizer`.
    return optax.flatten(optax.scale_by_adam())


def init(
    key: jax.Array, config: Config, observation_size: int, action_size: int
) -> Learner:
    """Return an untrained discriminator. The key is consumed."""
    params = _network(config).init(
        key, jnp.zeros(observation_size), jnp.zeros(action_size)
    )
    return learner.init(params, _optimizer())


class Source(NamedTuple):
    """The source of the pairs that the policy imitates.

    Attributes:
      sample: (key, context, n) -> observation (n, obs), action (n, action).
      is_ready: context -> bool (), whether there is anything to sample.
    """

    sample: Callable[[jax.Array, Context, int], tuple[jax.Array, jax.Array]]
    is_ready: Callable[[Context], jax.Array]


def _sample_good(
    key: jax.Array, context: Context, num_samples: int
) -> tuple[jax.Array, jax.Array]:
    return good_trajectories.sample(key, context.good_trajectories, num_samples)


def _sample_expert(
    key: jax.Array, context: Context, num_samples: int
) -> tuple[jax.Array, jax.Array]:
    assert context.config.expert is not None  # Ensured by `_check_expert`.
    observation, action = expert.load(context.config.expert)
    rows = jax.random.randint(key, (num_samples,), 0, observation.shape[0])
    return jnp.asarray(observation)[rows], jnp.asarray(action)[rows]


GOOD_TRAJECTORIES = Source(
    _sample_good, lambda context: context.good_trajectories.size > 0
)
_EXPERT = Source(_sample_expert, lambda context: jnp.bool_(True))


def _train_discriminator(
    state: Learner, source: Source, context: Context, key: jax.Array
) -> tuple[Learner, Metrics]:
    """Take gradient steps on the discriminator, if the source is ready.

    The loop takes as many steps as the config's own `discriminator_updates`, and keeps
    only the first `discriminator_updates` of this member's hyperparameters.
    """
    config: Config = context.config
    hyperparameters: Hyperparameters = context.hyperparameters
    network, transform = _network(config), _optimizer()
    rollout = context.rollout
    observation = rollout.observation.reshape(-1, rollout.observation.shape[-1])
    action = rollout.action.reshape(-1, rollout.action.shape[-1])
    minibatch_size = config.discriminator_minibatch_size

    def objective(params: Any, policy_pair: Any, good_pair: Any) -> Any:
        return loss(
            network.apply(params, *policy_pair),
            network.apply(params, *good_pair),
            hyperparameters.discriminator_entropy_coefficient,
        )

    def step(state: Learner, key_and_counts: tuple[Any, Any]) -> Any:
        key, counts = key_and_counts
        policy_key, good_key = jax.random.split(key)
        rows = jax.random.randint(
            policy_key, (minibatch_size,), 0, observation.shape[0]
        )
        normalize = lambda x: normalization.normalize(context.normalizer, x)
        good_observation, good_action = source.sample(good_key, context, minibatch_size)
        gradient, metrics = jax.grad(objective, has_aux=True)(
            state.params,
            (normalize(observation[rows]), action[rows]),
            (normalize(good_observation), good_action),
        )
        stepped = learner.descend(
            state, gradient, transform, hyperparameters.discriminator_learning_rate
        )
        return choose(counts, stepped, state), metrics

    choose = lambda condition, new, old: jax.tree.map(
        lambda a, b: jnp.where(condition, a, b), new, old
    )
    num_updates = config.hyperparameters.discriminator_updates
    counts = jnp.arange(num_updates) < jnp.asarray(
        hyperparameters.discriminator_updates, jnp.int32
    )
    trained, metrics = jax.lax.scan(
        step, state, (jax.random.split(key, num_updates), counts)
    )
    ready = source.is_ready(context)
    # Times the inverse, as XLA divides by a constant: a single run has the same bits.
    mean = lambda x: jnp.sum(x, where=counts) * (1.0 / jnp.sum(counts))
    metrics = {
        name: jnp.where(ready, mean(value), jnp.nan) for name, value in metrics.items()
    }
    return choose(ready, trained, state), metrics


def update_and_score(
    state: Learner, context: Context, key: jax.Array, source: Source = GOOD_TRAJECTORIES
) -> tuple[Learner, jax.Array, Metrics]:
    """Train the discriminator, and give each step of the batch its bonus.

    Args:
      state: the discriminator.
      context: of the iteration.
      key: consumed.
      source: what the policy imitates.

    Returns:
      The discriminator, the bonus without alpha, float32 (time, env), 0 where there is
      nothing to imitate yet, and metrics.
    """
    state, metrics = _train_discriminator(state, source, context, key)
    rollout = context.rollout
    observation = normalization.normalize(context.normalizer, rollout.observation)
    logit = _network(context.config).apply(state.params, observation, rollout.action)
    form = BONUSES[context.config.bonus]
    return state, jnp.where(source.is_ready(context), form(logit), 0.0), metrics


def _update_and_reward(
    source: Source,
    combine: Callable[[jax.Array, jax.Array], jax.Array],
) -> Callable[[Learner, Context, jax.Array], Any]:
    def update_and_reward(
        state: Learner, context: Context, key: jax.Array
    ) -> tuple[Learner, jax.Array, Metrics]:
        state, bonus, metrics = update_and_score(state, context, key, source)
        shaped = context.hyperparameters.alpha * bonus
        metrics["bonus"] = jnp.mean(shaped)
        metrics["bonus_deviation"] = jnp.std(shaped)
        return state, combine(context.rollout.reward, shaped), metrics

    return update_and_reward


def _check_expert(config: Config, observation_size: int, action_size: int) -> None:
    expert.check(config.expert, observation_size, action_size)


_reward_and_bonus = lambda reward, bonus: reward + bonus
_bonus_alone = lambda reward, bonus: bonus

#: What every discriminator uses.
FIELDS = (
    "bonus",
    "discriminator_learning_rate",
    "discriminator_entropy_coefficient",
    "discriminator_updates",
    "discriminator_minibatch_size",
)
_FIELDS = ("alpha", *FIELDS)
_FIELDS_OF_BUFFER = (*_FIELDS, "buffer_steps")

#: r - alpha log D (section 4.3).
PPO_GASIL = Imitation(
    init,
    _update_and_reward(GOOD_TRAJECTORIES, _reward_and_bonus),
    leave_policy,
    fields=_FIELDS_OF_BUFFER,
)
#: -alpha log D alone (Algorithm 1).
GASIL = Imitation(
    init,
    _update_and_reward(GOOD_TRAJECTORIES, _bonus_alone),
    leave_policy,
    fields=_FIELDS_OF_BUFFER,
)
#: -alpha log D alone, D against expert trajectories (section 3.2).
GAIL = Imitation(
    init,
    _update_and_reward(_EXPERT, _bonus_alone),
    leave_policy,
    _check_expert,
    _FIELDS,
)
