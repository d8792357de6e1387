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

from gasil_jax import learner, normalization
from gasil_jax.agents import expert
from gasil_jax.agents.buffered import BufferedAgent
from gasil_jax.agents.interface import Agent
from gasil_jax.config import (
    Schedule,
    choice,
    count,
    number,
    schedule,
    switch,
    text,
    widths,
)
from gasil_jax.context import Context, Metrics, Sizes
from gasil_jax.good_trajectories import GoodTrajectories
from gasil_jax.learner import Learner
from gasil_jax.networks import Discriminator
from gasil_jax.rollout import Rollout


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


_ABSORBING = "absorbing"
#: The forms of the bonus, functions of the logit of D on a batch, (time, env). With
#: "absorbing" a step that terminates its episode is also paid for what comes after.
BONUSES: Mapping[str, Callable[[jax.Array], jax.Array]] = {
    "softplus": softplus_bonus,
    "logit": logit_bonus,
    "dail": dail_bonus,
    "centered": centered_bonus,
    _ABSORBING: softplus_bonus,
}


def absorbed_share(
    length: jax.Array, terminated: jax.Array, counted: jax.Array, gamma: Any
) -> jax.Array:
    """Return the mean share of discounted time in the absorbing state, float32 ().

    An episode that terminates after T steps is in the absorbing state from then on,
    which is the share gamma^T of its discounted time. For a truncated episode the share
    is 0. One imaginary episode with the share 1/2 is added, so that the result is never
    0 or 1.

    Args:
      length: int32, any shape, number of steps of each episode.
      terminated: bool, the same shape, whether the episode terminated.
      counted: bool, the same shape, false for entries that are not the end of an
        episode.
      gamma: the discount factor.
    """
    share = jnp.where(counted & terminated, gamma**length, 0.0)
    return (jnp.sum(share) + 0.5) / (jnp.sum(counted) + 1.0)


def absorbing_logit(
    buffer: GoodTrajectories, rollout: Rollout, gamma: Any
) -> jax.Array:
    """Return the logit of D in the absorbing state, (): its best value in closed form.

    It is the log odds of the policy's absorbed share against the buffer's.
    """
    assert buffer.terminated is not None  # Ensured by `keeps_terminated`.
    step = jnp.arange(buffer.capacity)
    starts_next = jnp.append(buffer.time[1:] == 0, True) | (step + 1 >= buffer.size)
    good = absorbed_share(
        buffer.time + 1, buffer.terminated, starts_next & buffer.filled, gamma
    )
    policy = absorbed_share(
        rollout.episode_length, rollout.terminated, rollout.completed, gamma
    )
    return jnp.log(policy) - jnp.log(good)


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
    logit: Callable[..., jax.Array],
    policy_pair: Any,
    good_pair: Any,
    *,
    share: jax.Array,
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


# Lower bound of 1 - gamma: with gamma 1 the absorbing state's value would be infinite.
_LEAST_ONE_MINUS_GAMMA = 1e-3
_NORMALIZES_ACTIONS = "discriminator_normalizes_actions"


class Source(NamedTuple):
    """The source of the pairs that the policy imitates.

    Attributes:
      sample: (key, n) -> observation (n, obs), action (n, action).
      is_ready: bool (), whether there is anything to sample.
      absorbing_logit: (rollout, gamma) -> the logit of D in the absorbing state, ();
        None where it is not known how the imitated episodes end.
    """

    sample: Callable[[jax.Array, int], tuple[jax.Array, jax.Array]]
    is_ready: jax.Array
    absorbing_logit: Callable[[Rollout, Any], jax.Array] | None = None


class AdversarialAgent(Agent):
    """An agent with a discriminator.

    Attributes:
      bonus: form of the discriminator's reward: softplus, -log D, as in the paper;
        logit, log(1 - D) - log D; dail, between 0 and 1; centered, softplus minus its
        mean over the batch; or absorbing, softplus, and where an episode terminates
        also the value of an absorbing state.
      discriminator_learning_rate: Adam's step size for the discriminator.
      discriminator_updates: gradient steps of the discriminator in an iteration.
      discriminator_minibatch_size: steps of the policy, and as many good steps, in one
        gradient step of the discriminator.
      discriminator_hidden_sizes: widths of the discriminator's tanh layers.
      discriminator_entropy_coefficient: weight of the entropy of the discriminator's
        output.
      discriminator_gradient_penalty: weight of a gradient penalty on the
        discriminator, as in WGAN-GP: at points between good pairs and the policy's, the
        norm of its gradient with respect to its input is pulled to 1.
      discriminator_normalizes_actions: whether the discriminator sees actions in units
        of the batch's mean and standard deviation; otherwise as they are.
    """

    bonus: str = choice("softplus", BONUSES)
    discriminator_learning_rate: float = number(1e-4, 0.0, excludes_low=True)
    discriminator_updates: int = count(5)
    discriminator_minibatch_size: int = count(128)
    discriminator_hidden_sizes: tuple[int, ...] = widths(100, 100)
    discriminator_entropy_coefficient: float = number(1e-3, 0.0)
    # Without a penalty its gradient is not computed.
    discriminator_gradient_penalty: float = number(0.0, 0.0, traced=False)
    discriminator_normalizes_actions: bool = switch(False)

    def discriminator_network(self) -> Any:
        """Return the Flax module of the logit: (..., obs), (..., action) -> (...).

        Observations are normalized, and discrete actions one-hot.
        """
        # Typed as Any because Flax declares that `apply` may also return variables.
        return Discriminator(self.discriminator_hidden_sizes)

    def init_discriminator(self, key: jax.Array, sizes: Sizes) -> Learner:
        """Return an untrained discriminator; consumes the key."""
        pair = jnp.zeros(sizes.observation), jnp.zeros(sizes.action)
        return learner.init(
            self.discriminator_network().init(key, *pair), learner.adam()
        )

    @jax.named_scope("discriminator")
    def update_and_score(
        self, discriminator: Learner, source: Source, context: Context, key: jax.Array
    ) -> tuple[Learner, jax.Array, Metrics]:
        """Train the discriminator, and return the bonus of each step of the batch.

        Args:
          discriminator: the discriminator before the update.
          source: the pairs that the policy imitates.
          context: the iteration's data.
          key: random key; consumed.

        Returns:
          The discriminator; the bonus without alpha, float32 (time, env), which is 0
          while there is nothing to imitate; and metrics.
        """
        discriminator, metrics = self._train(discriminator, source, context, key)
        rollout = context.rollout
        pairs = self._preprocessor(context)(rollout.observation, rollout.action)
        logit = self.discriminator_network().apply(discriminator.params, *pairs)
        bonus = BONUSES[self.bonus](logit)
        if self.bonus == _ABSORBING:
            assert source.absorbing_logit is not None  # Ensured by `check`.
            gamma = context.config.gamma
            after = BONUSES[self.bonus](source.absorbing_logit(rollout, gamma))
            horizon = gamma / jnp.maximum(1.0 - gamma, _LEAST_ONE_MINUS_GAMMA)
            bonus += jnp.where(rollout.terminated, horizon * after, 0.0)
        return discriminator, jnp.where(source.is_ready, bonus, 0.0), metrics

    def discriminator(self, state: Any) -> Learner:
        """Return the discriminator in a state."""
        return state.discriminator

    def reward(
        self, state: Any, normalizer: normalization.Normalizer
    ) -> Callable[[jax.Array, jax.Array], jax.Array]:
        """Return the bonus without alpha as a function of observation and action.

        The function is (..., obs), (..., action) -> (...).

        Args:
          state: the agent's state.
          normalizer: the normalizer of observations.

        Raises:
          ValueError: if the bonus of a step depends on the batch that it is in.
        """
        depends = self.bonus in ("centered", _ABSORBING)
        if depends or self.discriminator_normalizes_actions:
            name = "bonus" if depends else _NORMALIZES_ACTIONS
            raise ValueError(
                f"{name} is {getattr(self, name)!r}: the reward of a step then depends "
                "on the batch that it is in"
            )
        params, network = self.discriminator(state).params, self.discriminator_network()

        def reward(observation: jax.Array, action: jax.Array) -> jax.Array:
            observation = normalization.normalize(normalizer, observation)
            return BONUSES[self.bonus](network.apply(params, observation, action))

        return reward

    def _preprocessor(
        self, context: Context
    ) -> Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
        """Return the function that makes the discriminator's inputs from pairs."""

        def normalize(x: jax.Array) -> jax.Array:
            return normalization.normalize(context.normalizer, x)

        if not self.discriminator_normalizes_actions:
            return lambda observation, action: (normalize(observation), action)
        actions = context.rollout.action
        batch = normalization.update(normalization.init(actions.shape[-1]), actions)
        return lambda observation, action: (
            normalize(observation),
            normalization.normalize(batch, action),
        )

    def _train(
        self, discriminator: Learner, source: Source, context: Context, key: jax.Array
    ) -> tuple[Learner, Metrics]:
        """Take gradient steps on the discriminator, if the source is ready."""
        network, transform = self.discriminator_network(), learner.adam()
        rollout = context.rollout
        observation = rollout.observation.reshape(-1, rollout.observation.shape[-1])
        action = rollout.action.reshape(-1, rollout.action.shape[-1])
        minibatch_size = self.discriminator_minibatch_size
        preprocess = self._preprocessor(context)
        penalty = self.discriminator_gradient_penalty

        def objective(params: Any, policy_pair: Any, good_pair: Any, key: Any) -> Any:
            value, metrics = loss(
                network.apply(params, *policy_pair),
                network.apply(params, *good_pair),
                self.discriminator_entropy_coefficient,
            )
            if penalty:
                share = jax.random.uniform(key, (minibatch_size,))

                def logit(*pair: Any) -> Any:
                    return network.apply(params, *pair)

                value += penalty * gradient_penalty(
                    logit, policy_pair, good_pair, share=share
                )
            return value, metrics

        def step(discriminator: Learner, key: jax.Array) -> Any:
            policy_key, good_key, between_key = jax.random.split(key, 3)
            rows = jax.random.randint(
                policy_key, (minibatch_size,), 0, observation.shape[0]
            )
            gradient, metrics = jax.grad(objective, has_aux=True)(
                discriminator.params,
                preprocess(observation[rows], action[rows]),
                preprocess(*source.sample(good_key, minibatch_size)),
                between_key,
            )
            stepped = learner.descend(
                discriminator,
                gradient,
                transform,
                step_size=self.discriminator_learning_rate,
            )
            return stepped, metrics

        keys = jax.random.split(key, self.discriminator_updates)
        trained, metrics = jax.lax.scan(step, discriminator, keys)
        ready = source.is_ready
        metrics = {
            name: jnp.where(ready, jnp.mean(value), jnp.nan)
            for name, value in metrics.items()
        }
        return learner.select(ready, trained, discriminator), metrics


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

    def shape(self, context: Context, bonus: jax.Array) -> tuple[jax.Array, Metrics]:
        """Return the rewards that PPO maximizes, (time, env), and metrics."""
        shaped = self.alpha * bonus
        metrics = {"bonus": jnp.mean(shaped), "bonus_deviation": jnp.std(shaped)}
        reward = context.rollout.reward
        return (reward + shaped if self.uses_reward else shaped), metrics


class SelfImitation(struct.PyTreeNode):
    """The discriminator and what it learns from.

    Attributes:
      discriminator: D.
      buffer: the good-trajectory buffer, B in the paper.
    """

    discriminator: Learner
    buffer: GoodTrajectories


class SelfImitatingAgent(AdversarialAgent, BufferedAgent):
    """An agent whose discriminator learns from the buffer, `state.buffer`."""

    def remember(self, state: Any, context: Context) -> Any:
        """Insert the episodes that ended in a batch into the buffer."""
        return state.replace(buffer=self.insert(state.buffer, context))

    def good_trajectories(self, state: Any) -> GoodTrajectories:
        """Return the buffer in a state."""
        return state.buffer

    def source(self, buffer: GoodTrajectories) -> Source:
        """Return the buffer as the source of what the policy imitates."""
        return Source(
            lambda key, num_samples: self.sample(buffer, key, num_samples),
            buffer.size > 0,
            lambda rollout, gamma: absorbing_logit(buffer, rollout, gamma),
        )

    @property
    def keeps_terminated(self) -> bool:
        """Whether the buffer keeps how its episodes ended."""
        return self.bonus == _ABSORBING


class PPOGASIL(ShapedRewardAgent, SelfImitatingAgent):
    """PPO on r - alpha log D (section 4.3)."""

    name = "ppo+gasil"

    def init(self, key: jax.Array, sizes: Sizes) -> SelfImitation:
        """Return an untrained discriminator and an empty buffer."""
        return SelfImitation(
            self.init_discriminator(key, sizes), self.init_buffer(sizes)
        )

    def update_and_reward(
        self, state: SelfImitation, context: Context, key: jax.Array
    ) -> tuple[SelfImitation, jax.Array, Metrics]:
        """Train the discriminator (equation 8), and shape the reward with it."""
        buffer = state.buffer
        discriminator, bonus, metrics = self.update_and_score(
            state.discriminator, self.source(buffer), context, key
        )
        reward, shaped = self.shape(context, bonus)
        state = state.replace(discriminator=discriminator)
        return state, reward, {**metrics, **shaped, **self.buffer_metrics(buffer)}


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
        """Raise `ValueError` unless there is a fitting expert and a fitting bonus."""
        if self.bonus == _ABSORBING:
            others = ", ".join(x for x in BONUSES if x != _ABSORBING)
            raise ValueError(
                f"bonus is {_ABSORBING!r}: an expert does not say how its episodes "
                f"end, so it must be one of {others}"
            )
        expert.check(self.expert, sizes)

    def discriminator(self, state: Learner) -> Learner:
        """Return the discriminator, which is the state."""
        return state

    def data(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the expert's observations (steps, obs) and actions.

        Actions are (steps, action), or numbers (steps,) where they are discrete.
        """
        assert self.expert is not None  # Ensured by `check`.
        return expert.load(self.expert)

    def init(self, key: jax.Array, sizes: Sizes) -> Learner:
        """Return an untrained discriminator."""
        return self.init_discriminator(key, sizes)

    def update_and_reward(
        self, state: Learner, context: Context, key: jax.Array
    ) -> tuple[Learner, jax.Array, Metrics]:
        """Train the discriminator (equation 8), and reward with it alone."""
        observation, action = context.data
        size = context.rollout.action.shape[-1]

        def sample(key: jax.Array, num_samples: int) -> tuple[jax.Array, jax.Array]:
            rows = jax.random.randint(key, (num_samples,), 0, observation.shape[0])
            return observation[rows], expert.vectors(action[rows], size)

        source = Source(sample, jnp.bool_(True))
        state, bonus, metrics = self.update_and_score(state, source, context, key)
        reward, shaped = self.shape(context, bonus)
        return state, reward, {**metrics, **shaped}
