"""Generative adversarial self-imitation (paper, section 4).

Signs are the paper's. D(s, a) is the probability that the pair comes from the policy
and not from the buffer; the discriminator ascends

    E_pi[log D(s, a)] + E_B[log(1 - D(s, a))]

and the policy receives the bonus -alpha log D(s, a) >= 0, which is larger for pairs
that look like the buffer's. Everything is computed from the logit l of D:
log D = -softplus(-l), log(1 - D) = -softplus(l). As in the paper the bonus is never
negative, so it favours long episodes (survival bias).

While the buffer is empty, D does not train and the bonus is 0. GAIL is the same method
with a fixed set of expert pairs instead of the buffer.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gasil_jax import good_trajectories, learner, normalization
from gasil_jax.config import Config
from gasil_jax.imitation import expert
from gasil_jax.imitation.interface import Context, Imitation, Metrics, leave_policy
from gasil_jax.learner import Learner
from gasil_jax.networks import Discriminator


def softplus_bonus(logit: jax.Array) -> jax.Array:
    """Return -log D (paper, section 4.3): never negative, favours long episodes."""
    return jax.nn.softplus(-logit)


def logit_bonus(logit: jax.Array) -> jax.Array:
    """Return log(1 - D) - log D (AIRL, Fu et al. 2018): positive or negative.

    It is 0 where D is 1/2, so it favours neither long nor short episodes.
    """
    return -logit


def dail_bonus(logit: jax.Array) -> jax.Array:
    """Return sigmoid(x) (tanh(x) + 1) / 2 of x = -logit (DAIL, arXiv:2510.00922).

    It is between 0 and 1, so it favours long episodes, but it is almost 0 where D is
    near 1.
    """
    return 0.5 * jax.nn.sigmoid(-logit) * (jnp.tanh(-logit) + 1.0)


def centered_bonus(logit: jax.Array) -> jax.Array:
    """Return -log D minus its mean over the batch: positive or negative.

    An average step gets 0, so it favours neither long nor short episodes.
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
      entropy_coefficient: weight of the entropy of D's output, averaged over all
        pairs, which keeps D away from 0 and 1 (as in OpenAI baselines' GAIL).

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
        "discriminator_policy_accuracy": jnp.mean(policy_logit > 0),
        "discriminator_good_accuracy": jnp.mean(good_logit < 0),
    }
    return -log_likelihood - entropy_coefficient * entropy, metrics


def gradient_penalty(
    logit: Callable[..., jax.Array], policy_pair: Any, good_pair: Any, share: jax.Array
) -> jax.Array:
    """Return the mean of (|gradient of the logit| - 1)^2 between pairs, ().

    See Gulrajani et al. 2017, algorithm 1.

    Args:
      logit: (observation, action) -> (minibatch,), the logit of D.
      policy_pair: the policy's observations (minibatch, obs) and actions
        (minibatch, action).
      good_pair: the same, from the buffer.
      share: (minibatch,), from 0 to 1, the weight of the policy's pair in the point at
        which the gradient is taken.
    """
    between = jax.tree.map(
        lambda x, y: share[:, None] * x + (1.0 - share[:, None]) * y,
        policy_pair,
        good_pair,
    )
    gradients = jax.grad(lambda pair: jnp.sum(logit(*pair)))(between)
    squares = sum(jnp.sum(x**2, axis=-1) for x in gradients)
    # The square root has no finite gradient at 0.
    return jnp.mean((jnp.sqrt(squares + 1e-12) - 1.0) ** 2)


def _network(config: Config) -> Any:
    # Typed as Any because Flax declares that `apply` may also return variables.
    return Discriminator(config.discriminator_hidden_sizes)


def init(
    key: jax.Array, config: Config, observation_size: int, action_size: int
) -> Learner:
    """Return an untrained discriminator. The key is consumed."""
    params = _network(config).init(
        key, jnp.zeros(observation_size), jnp.zeros(action_size)
    )
    return learner.init(params, learner.adam())


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
    return good_trajectories.sample(
        key, context.good_trajectories, num_samples, context.config.sample_by_return
    )


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


def _preprocessor(
    context: Context,
) -> Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
    """Return the function that makes the discriminator's inputs from pairs."""
    normalize = lambda x: normalization.normalize(context.normalizer, x)
    if not context.config.discriminator_normalizes_actions:
        return lambda observation, action: (normalize(observation), action)
    actions = context.rollout.action
    batch = normalization.update(normalization.init(actions.shape[-1]), actions)
    return lambda observation, action: (
        normalize(observation),
        normalization.normalize(batch, action),
    )


def _train_discriminator(
    state: Learner, source: Source, context: Context, key: jax.Array
) -> tuple[Learner, Metrics]:
    """Take gradient steps on the discriminator, if the source is ready.

    The loop has as many steps as the config's `discriminator_updates`, which is static.
    Only the first ones, as many as this run's own `discriminator_updates`, are kept.
    """
    config, hyperparameters = context.config, context.hyperparameters
    network, transform = _network(config), learner.adam()
    rollout = context.rollout
    observation = rollout.observation.reshape(-1, rollout.observation.shape[-1])
    action = rollout.action.reshape(-1, rollout.action.shape[-1])
    minibatch_size = config.discriminator_minibatch_size

    preprocess = _preprocessor(context)
    penalty = config.discriminator_gradient_penalty

    def objective(params: Any, policy_pair: Any, good_pair: Any, key: Any) -> Any:
        value, metrics = loss(
            network.apply(params, *policy_pair),
            network.apply(params, *good_pair),
            hyperparameters.discriminator_entropy_coefficient,
        )
        if penalty:
            share = jax.random.uniform(key, (minibatch_size,))
            logit = lambda *pair: network.apply(params, *pair)
            value += penalty * gradient_penalty(logit, policy_pair, good_pair, share)
        return value, metrics

    def step(state: Learner, key_and_is_taken: tuple[Any, Any]) -> Any:
        key, is_taken = key_and_is_taken
        policy_key, good_key, between_key = jax.random.split(key, 3)
        rows = jax.random.randint(
            policy_key, (minibatch_size,), 0, observation.shape[0]
        )
        gradient, metrics = jax.grad(objective, has_aux=True)(
            state.params,
            preprocess(observation[rows], action[rows]),
            preprocess(*source.sample(good_key, context, minibatch_size)),
            between_key,
        )
        stepped = learner.descend(
            state, gradient, transform, hyperparameters.discriminator_learning_rate
        )
        return learner.select(is_taken, stepped, state), metrics

    num_updates = config.hyperparameters.discriminator_updates
    is_taken = jnp.arange(num_updates) < jnp.asarray(
        hyperparameters.discriminator_updates, jnp.int32
    )
    trained, metrics = jax.lax.scan(
        step, state, (jax.random.split(key, num_updates), is_taken)
    )
    ready = source.is_ready(context)
    # XLA turns a division by a constant into this product. So a constant count and a
    # traced one give the same bits.
    mean = lambda x: jnp.sum(x, where=is_taken) * (1.0 / jnp.sum(is_taken))
    metrics = {
        name: jnp.where(ready, mean(value), jnp.nan) for name, value in metrics.items()
    }
    return learner.select(ready, trained, state), metrics


@jax.named_scope("discriminator")
def update_and_score(
    state: Learner, context: Context, key: jax.Array, source: Source = GOOD_TRAJECTORIES
) -> tuple[Learner, jax.Array, Metrics]:
    """Train the discriminator, and return the bonus of each step of the batch.

    Args:
      state: the discriminator.
      context: the iteration's data.
      key: random key; consumed.
      source: the pairs that the policy imitates.

    Returns:
      The discriminator; the bonus without alpha, float32 (time, env), which is 0 while
      there is nothing to imitate; and metrics.
    """
    state, metrics = _train_discriminator(state, source, context, key)
    rollout = context.rollout
    pairs = _preprocessor(context)(rollout.observation, rollout.action)
    logit = _network(context.config).apply(state.params, *pairs)
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

#: Fields that every agent with a discriminator uses.
FIELDS = (
    "bonus",
    "discriminator_learning_rate",
    "discriminator_hidden_sizes",
    "discriminator_entropy_coefficient",
    "discriminator_updates",
    "discriminator_minibatch_size",
    "discriminator_gradient_penalty",
    "discriminator_normalizes_actions",
)
_GAIL_FIELDS = ("alpha", "alpha_schedule", *FIELDS)
_GASIL_FIELDS = (*_GAIL_FIELDS, *good_trajectories.FIELDS)

#: r - alpha log D (section 4.3).
PPO_GASIL = Imitation(
    init,
    _update_and_reward(GOOD_TRAJECTORIES, _reward_and_bonus),
    leave_policy,
    fields=_GASIL_FIELDS,
)
#: -alpha log D alone (Algorithm 1).
GASIL = Imitation(
    init,
    _update_and_reward(GOOD_TRAJECTORIES, _bonus_alone),
    leave_policy,
    fields=_GASIL_FIELDS,
    uses_reward=False,
)
#: -alpha log D alone, D against expert trajectories (section 3.2).
GAIL = Imitation(
    init,
    _update_and_reward(_EXPERT, _bonus_alone),
    leave_policy,
    _check_expert,
    _GAIL_FIELDS,
    uses_reward=False,
)
