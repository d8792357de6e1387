"""Generative adversarial self-imitation (paper, section 4).

Signs are the paper's. D(s, a) is the probability that the pair comes from the policy
and not from the buffer; the discriminator ascends

    E_pi[log D(s, a)] + E_B[log(1 - D(s, a))]

and the policy receives the bonus -alpha log D(s, a) >= 0, which is larger for pairs
that look like the buffer's. Everything is computed from the logit l of D:
log D = -softplus(-l), log(1 - D) = -softplus(l). This bonus, the paper's and the
default, is never negative, so it favours long episodes (survival bias). `BONUSES` has
other forms.

While the buffer is empty, D does not train and the bonus is 0. GAIL is the same method
with a fixed set of expert pairs instead of the buffer.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from gasil_jax import buffer as good_trajectories
from gasil_jax import learner, normalization
from gasil_jax.agents import expert
from gasil_jax.agents.buffered import BufferedAgent
from gasil_jax.agents.interface import Agent
from gasil_jax.config import Schedule, choice, count, number, schedule, text, widths
from gasil_jax.context import Context, Metrics, Sizes
from gasil_jax.learner import Learner
from gasil_jax.networks import Discriminator
from gasil_jax.normalization import Normalizer


def softplus_bonus(logit: jax.Array) -> jax.Array:
    """Return -log D (paper, section 4.3): never negative, favours long episodes."""
    return jax.nn.softplus(-logit)


def logit_bonus(logit: jax.Array) -> jax.Array:
    """Return log(1 - D) - log D (AIRL, Fu et al. 2018), which is 0 where D is 1/2."""
    return -logit


def centered_bonus(logit: jax.Array) -> jax.Array:
    """Return -log D minus its mean over the batch: an average step gets 0."""
    softplus = softplus_bonus(logit)
    return softplus - jnp.mean(softplus)


#: The forms of the bonus, functions of the logit of D on a batch, (time, env).
BONUSES: Mapping[str, Callable[[jax.Array], jax.Array]] = {
    "softplus": softplus_bonus,
    "logit": logit_bonus,
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


class Source(NamedTuple):
    """The source of the pairs that the policy imitates."""

    #: (key, n) -> observation (n, obs), action (n, action).
    sample: Callable[[jax.Array, int], tuple[jax.Array, jax.Array]]
    is_ready: jax.Array  # bool (), whether there is anything to sample


class Imitation(struct.PyTreeNode):
    """The state of an adversarial agent."""

    discriminator: Learner  # D
    buffer: Any = None  # `GoodTrajectories`, B in the paper; GAIL has none


class AdversarialAgent(Agent):
    """An agent with a discriminator, `state.discriminator`.

    Attributes:
      bonus: form of the discriminator's reward: softplus, -log D, as in the paper;
        logit, log(1 - D) - log D; or centered, softplus minus its mean over the batch.
      discriminator_learning_rate: Adam's step size for the discriminator.
      discriminator_updates: gradient steps of the discriminator in an iteration.
      discriminator_minibatch_size: steps of the policy, and as many good steps, in one
        gradient step of the discriminator.
      discriminator_hidden_sizes: widths of the discriminator's tanh layers.
      discriminator_entropy_coefficient: weight of the entropy of the discriminator's
        output.
    """

    bonus: str = choice("softplus", BONUSES)
    discriminator_learning_rate: float = number(1e-4, 0.0, excludes_low=True)
    discriminator_updates: int = count(5)
    discriminator_minibatch_size: int = count(128)
    discriminator_hidden_sizes: tuple[int, ...] = widths(100, 100)
    discriminator_entropy_coefficient: float = number(1e-3, 0.0)

    def source(self, state: Any, context: Context) -> Source:
        """Return the source of the pairs that the policy imitates."""
        raise NotImplementedError

    def discriminator_network(self) -> Any:
        """Return the Flax module of the logit: (..., obs), (..., action) -> (...).

        Observations are normalized, and discrete actions one-hot.
        """
        # Typed as Any because Flax declares that `apply` may also return variables.
        return Discriminator(self.discriminator_hidden_sizes)

    def init_discriminator(self, key: jax.Array, sizes: Sizes) -> Learner:
        """Return an untrained discriminator; consumes the key."""
        pair = jnp.zeros(sizes.observation), jnp.zeros(sizes.action)
        params = self.discriminator_network().init(key, *pair)
        return learner.init(params, learner.adam())

    def logit(
        self, params: Any, normalizer: Normalizer, observation: Any, action: Any
    ) -> jax.Array:
        """Return the logit of D, (...), of observations (..., obs) and actions."""
        observation = normalization.normalize(normalizer, observation)
        return self.discriminator_network().apply(params, observation, action)

    @jax.named_scope("discriminator")
    def update_and_score(
        self, state: Any, context: Context, key: jax.Array
    ) -> tuple[Learner, jax.Array, Metrics]:
        """Train the discriminator, and return the bonus of each step of the batch.

        Returns:
          The discriminator; the bonus without alpha, float32 (time, env), which is 0
          while there is nothing to imitate; and metrics.
        """
        source, batch = self.source(state, context), context.rollout
        discriminator, metrics = self._train(state.discriminator, source, context, key)
        pairs = context.normalizer, batch.observation, batch.action
        bonus = BONUSES[self.bonus](self.logit(discriminator.params, *pairs))
        return discriminator, jnp.where(source.is_ready, bonus, 0.0), metrics

    def _train(
        self, discriminator: Learner, source: Source, context: Context, key: jax.Array
    ) -> tuple[Learner, Metrics]:
        """Take gradient steps on the discriminator, if the source is ready."""
        normalizer, size = context.normalizer, self.discriminator_minibatch_size
        steps = (context.rollout.observation, context.rollout.action)
        pairs = jax.tree.map(lambda x: x.reshape(-1, x.shape[-1]), steps)

        def objective(params: Any, policy_pairs: Any, good_pairs: Any) -> Any:
            return loss(
                self.logit(params, normalizer, *policy_pairs),
                self.logit(params, normalizer, *good_pairs),
                self.discriminator_entropy_coefficient,
            )

        def step(discriminator: Learner, key: jax.Array) -> Any:
            policy_key, good_key = jax.random.split(key)
            rows = jax.random.randint(policy_key, (size,), 0, pairs[0].shape[0])
            gradient, metrics = jax.grad(objective, has_aux=True)(
                discriminator.params,
                jax.tree.map(lambda x: x[rows], pairs),
                source.sample(good_key, size),
            )
            stepped = learner.descend(
                discriminator,
                gradient,
                learner.adam(),
                step_size=self.discriminator_learning_rate,
            )
            return stepped, metrics

        keys = jax.random.split(key, self.discriminator_updates)
        trained, metrics = jax.lax.scan(step, discriminator, keys)
        metrics = {
            name: jnp.where(source.is_ready, jnp.mean(value), jnp.nan)
            for name, value in metrics.items()
        }
        return learner.select(source.is_ready, trained, discriminator), metrics

    def reward(
        self, state: Any, normalizer: Normalizer
    ) -> Callable[[jax.Array, jax.Array], jax.Array]:
        """Return the bonus without alpha as a function of observation and action.

        The function is (..., obs), (..., action) -> (...). The normalizer is that of
        observations.

        Raises:
          ValueError: if the bonus of a step depends on the batch that it is in.
        """
        if self.bonus == "centered":
            raise ValueError(
                f"bonus is {self.bonus!r}: the reward of a step then depends on the "
                "batch that it is in"
            )
        params, form = state.discriminator.params, BONUSES[self.bonus]
        return lambda *pair: form(self.logit(params, normalizer, *pair))


class ShapedRewardAgent(AdversarialAgent):
    """An agent whose bonus is added to the environment's reward, or replaces it.

    Attributes:
      alpha: scale of the discriminator's reward (paper, section 4.3).
      alpha_schedule: factor that multiplies alpha, over environment steps: STEPS FACTOR
        pairs. On Humanoid the paper's alpha is 0 for 2M steps and then rises to its
        full value at 3M. That is 2e6 0 3e6 1 on the command line and
        ((2e6, 0), (3e6, 1)) in Python.
    """

    alpha: float = number(0.1, 0.0)
    alpha_schedule: Schedule = schedule()

    def init(self, key: jax.Array, sizes: Sizes) -> Imitation:
        return Imitation(self.init_discriminator(key, sizes))

    def update_and_reward(
        self, state: Imitation, context: Context, key: jax.Array
    ) -> tuple[Imitation, jax.Array, Metrics]:
        discriminator, bonus, metrics = self.update_and_score(state, context, key)
        bonus = self.alpha * bonus
        reward = context.rollout.reward + bonus if self.uses_reward else bonus
        metrics |= {"bonus": jnp.mean(bonus), "bonus_std": jnp.std(bonus)}
        return state.replace(discriminator=discriminator), reward, metrics


class SelfImitatingAgent(AdversarialAgent, BufferedAgent):
    """An agent whose discriminator learns from the buffer, `state.buffer`."""

    def source(self, state: Any, context: Context) -> Source:
        def sample(key: jax.Array, num_samples: int) -> tuple[jax.Array, jax.Array]:
            return good_trajectories.sample(key, state.buffer, num_samples)

        return Source(sample, state.buffer.size > 0)


class PPOGASIL(ShapedRewardAgent, SelfImitatingAgent):
    """PPO on r - alpha log D (section 4.3)."""

    name = "ppo+gasil"

    def init(self, key: jax.Array, sizes: Sizes) -> Imitation:
        return Imitation(self.init_discriminator(key, sizes), self.init_buffer(sizes))

    def update_and_reward(
        self, state: Imitation, context: Context, key: jax.Array
    ) -> tuple[Imitation, jax.Array, Metrics]:
        state, reward, metrics = super().update_and_reward(state, context, key)
        return state, reward, metrics | self.buffer_metrics(state.buffer)


class GASIL(PPOGASIL):
    """PPO on -alpha log D alone (Algorithm 1)."""

    name = "gasil"
    uses_reward = False


class GAIL(ShapedRewardAgent):
    """PPO on -alpha log D alone, with D against expert trajectories (section 3.2).

    Attributes:
      expert: expert that GAIL imitates: minari:NAME for a Minari data set, or an .npz
        file with the arrays "observation" and "action". Discrete actions are numbers.
    """

    name = "gail"
    uses_reward = False

    expert: str | None = text()

    def check(self, sizes: Sizes) -> None:
        expert.check(self.expert, sizes)

    def data(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the expert's observations (steps, obs) and actions.

        Actions are (steps, action), or numbers (steps,) where they are discrete.
        """
        assert self.expert is not None  # Ensured by `check`.
        return expert.load(self.expert)

    def source(self, state: Any, context: Context) -> Source:
        observation, action = context.data
        size = context.rollout.action.shape[-1]

        def sample(key: jax.Array, num_samples: int) -> tuple[jax.Array, jax.Array]:
            rows = jax.random.randint(key, (num_samples,), 0, observation.shape[0])
            return observation[rows], expert.vectors(action[rows], size)

        return Source(sample, jnp.bool_(True))
