"""Decompose a delayed reward into a reward for each step.

A window is the steps between two payouts: it ends where the reward is not zero or the
episode ends. The rewards alone show where windows end, so this works in any
environment. A network g of (observation, action, next observation) learns the
standardized reward of a step. With m and s the running mean and standard deviation of
payout / length, it takes gradient steps on

    (mean_window g - (payout / length - m) / s)^2.

A window that is longer than `decomposition_window_steps` is represented by as
many of its steps, drawn at random, as in randomized return decomposition (Ren et al.
2022, arXiv:2111.13485). Minibatches are drawn from all complete windows in the history.

PPO then learns from m + s g instead of the environment's reward. The difference
between a window's payout and the sum of m + s g over its steps is divided equally among
its steps. So a window's rewards sum to its payout; an untrained network spreads the
payout almost evenly; and where every step pays, the reward is the environment's own. If
a window began in an earlier batch, PPO has already learned from the window's earlier
steps, without their share of this difference. In the history these steps get their
share, so that agents that replay whole episodes see the complete rewards.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from gasil_jax import learner, normalization
from gasil_jax.config import count, number, widths
from gasil_jax.context import Context, Metrics, Sizes
from gasil_jax.learner import Learner
from gasil_jax.networks import StepReward
from gasil_jax.normalization import Normalizer
from gasil_jax.rewards.interface import RewardModel
from gasil_jax.rollout import History, write

# Largest count of float32 numbers in a part of a minibatch: 2 MB, which fits a CPU's
# cache.
_MOST = 2**19

# Shape letters: N environments, H steps of history per environment, T steps of a batch
# per environment, W windows of a minibatch, S steps that represent a window.


class Decomposition(struct.PyTreeNode):
    """The state of reward decomposition between iterations."""

    network: Learner  # g, a `networks.StepReward`
    rates: Normalizer  # moments of payout / length of all windows so far, (1,)
    reward: jax.Array  # float32 (N, H), the decomposed rewards of the history's steps
    open_reward: jax.Array  # float32 (N,), their sum over the running window
    open_steps: jax.Array  # float32 (N,), number of steps of the running window


class Windows(NamedTuple):
    """The windows that end in a stretch of steps; every field is (N, steps)."""

    ends: jax.Array  # bool, whether a complete window ends with this step
    payout: jax.Array  # float32, what the window paid
    length: jax.Array  # int32, number of steps of the window up to this one


def ends_window(reward: jax.Array, ended: jax.Array) -> jax.Array:
    """Return whether a window ends with a step, bool."""
    return (reward != 0) | ended


def windows(history: History) -> Windows:
    """Return the complete windows of a history, (N, H), in time order.

    A window whose first step is no longer in the history, and one that ends with a NaN
    reward, is left out.
    """
    reward, ended = history.in_time(history.reward), history.in_time(history.ended)
    index = jnp.arange(reward.shape[1], dtype=jnp.int32)[None]
    last = ends_window(reward, ended)
    latest = jax.lax.cummax(jnp.where(last, index, -1), axis=1)
    before = jnp.pad(latest[:, :-1], ((0, 0), (1, 0)), constant_values=-1)
    return Windows(
        ends=last & (before >= 0) & jnp.isfinite(reward),
        payout=reward,
        length=index - before,
    )


def window_sums(reward: jax.Array, ends: jax.Array, running: Any) -> Any:
    """Return each window's sum and length up to every step, (T, N) each.

    Args:
      reward: float32 (T, N).
      ends: bool (T, N), whether a window ends with this step.
      running: sum and number of steps, float32 (N,) each, of the windows that run when
        the batch begins; those that run when it ends are returned too.
    """

    def step(running: Any, now: Any) -> Any:
        reward, ends = now
        total, length = running[0] + reward, running[1] + 1.0
        running = jnp.where(ends, 0.0, total), jnp.where(ends, 0.0, length)
        return running, (total, length)

    running, (total, length) = jax.lax.scan(step, running, (reward, ends))
    return total, length, running


def at_window_end(values: jax.Array, ends: jax.Array) -> jax.Array:
    """Return each step's value at the end of its window, (T, N); 0 if it has none."""

    def backward(later: jax.Array, now: Any) -> Any:
        value, ends = now
        value = jnp.where(ends, value, later)
        return value, value

    start = jnp.zeros_like(values[0])
    return jax.lax.scan(backward, start, (values, ends), reverse=True)[1]


def goodness_of_fit(
    predicted: jax.Array, actual: jax.Array, valid: jax.Array
) -> Metrics:
    """Return how well the valid windows' payout / length, (T, N), is predicted.

    The metrics are "decomposition_fit", the share of its variance that is explained
    (R2), NaN where it does not vary, and "decomposition_error", the root of the mean
    squared error.
    """
    count = jnp.sum(valid)

    def mean(x: jax.Array) -> jax.Array:
        return jnp.sum(jnp.where(valid, x, 0.0)) / count

    error = mean((predicted - actual) ** 2)
    middle = mean(actual)
    variance = mean((actual - middle) ** 2)
    # A variance below this is rounding error of equal payouts.
    varies = (count > 1) & (variance > 1e-10 * middle**2)
    return {
        "decomposition_fit": jnp.where(varies, 1.0 - error / variance, jnp.nan),
        "decomposition_error": jnp.sqrt(error),
    }


def num_parts(num_windows: int, numbers_per_window: int) -> int:
    """Return the fewest equal parts of a minibatch that each fit a CPU's cache."""
    divisors = (n for n in range(1, num_windows) if num_windows % n == 0)
    fitting = (n for n in divisors if num_windows // n * numbers_per_window <= _MOST)
    return next(fitting, num_windows)


def mean_gradient(
    gradient: Callable[[Any, Any], Any], params: Any, minibatch: Any, *, parts: int
) -> Any:
    """Return the gradient of a mean over a minibatch, (W, ...), part by part."""
    if parts == 1:
        return gradient(params, minibatch)
    divided = jax.tree.map(lambda x: x.reshape(parts, -1, *x.shape[1:]), minibatch)

    def add(total: Any, part: Any) -> Any:
        return jax.tree.map(jnp.add, total, gradient(params, part)), None

    total, _ = jax.lax.scan(add, jax.tree.map(jnp.zeros_like, params), divided)
    return jax.tree.map(lambda x: x / parts, total)


def sample_window_steps(
    key: jax.Array, length: jax.Array, num_steps: int
) -> tuple[jax.Array, jax.Array]:
    """Draw the steps that represent each window, with their weights in its mean.

    A window of at most S steps is represented by all of them, a longer one by S of
    them, drawn with replacement. Lengths are int32 (W,). The steps are given by their
    distance from the window's last one, int32 (W, S); weights are float32 (W, S).
    """
    length = length[:, None]
    every = jnp.arange(num_steps, dtype=jnp.int32)[None]
    drawn = jax.random.uniform(key, (length.shape[0], num_steps)) * length
    fits = length <= num_steps
    offset = jnp.where(fits, every, drawn.astype(jnp.int32))
    weight = jnp.where(fits, (every < length) / length, 1.0 / num_steps)
    return jnp.clip(offset, 0, length - 1), weight


class Decompose(RewardModel):
    """Learn a reward for each step from the delayed sums; PPO learns from it instead.

    Attributes:
      decomposition_learning_rate: Adam's step size for the network that decomposes
        rewards.
      decomposition_updates: gradient steps per iteration for the network that
        decomposes rewards.
      decomposition_minibatch_size: windows in one gradient step of the network that
        decomposes rewards. A window is the steps between two payouts.
      decomposition_window_steps: largest number of steps of a window that a gradient
        step of the decomposition uses. From a longer window, this many are drawn at
        random.
      decomposition_history_episodes: length of the history that windows are drawn from,
        in episodes of full length; a batch is added to it. If rewards come only at the
        end of an episode, 1 leaves few windows.
      decomposition_hidden_sizes: widths of the tanh layers of the network that
        decomposes rewards.
    """

    switch = "decompose_rewards"

    decomposition_learning_rate: float = number(1e-3, 0.0, excludes_low=True)
    decomposition_updates: int = count(20)
    decomposition_minibatch_size: int = count(64)
    decomposition_window_steps: int = count(32)
    decomposition_history_episodes: int = count(1)
    decomposition_hidden_sizes: tuple[int, ...] = widths(100, 100)

    @property
    def keeps_next_observation(self) -> bool:
        return True

    @property
    def history_episodes(self) -> int:
        return self.decomposition_history_episodes

    @property
    def _network(self) -> Any:  # Flax declares that `apply` may return variables too.
        return StepReward(self.decomposition_hidden_sizes)

    def init(self, key: jax.Array, sizes: Sizes) -> Decomposition:
        observation, action = jnp.zeros(sizes.observation), jnp.zeros(sizes.action)
        inputs = (observation, action, observation)
        params = self._network.init(key, *inputs)
        return Decomposition(
            network=learner.init(params, learner.adam()),
            rates=normalization.init(1),
            reward=jnp.zeros((sizes.num_envs, sizes.history_steps), jnp.float32),
            open_reward=jnp.zeros(sizes.num_envs, jnp.float32),
            open_steps=jnp.zeros(sizes.num_envs, jnp.float32),
        )

    def update(
        self, state: Decomposition, context: Context, key: jax.Array
    ) -> tuple[Decomposition, Context, jax.Array, Metrics]:
        """Train the network on complete windows, and decompose a batch's rewards.

        If the network's update is not finite, it is undone. The rest of the state
        belongs to the recorded steps and is updated in any case. The metrics are the
        `goodness_of_fit` of the batch's windows of more than one step, predicted before
        training on them.
        """
        batch, history = context.rollout, context.history
        assert history is not None  # Ensured by `history_episodes`.

        def predict(
            params: Any, observation: jax.Array, action: jax.Array, after: jax.Array
        ) -> jax.Array:
            observation = normalization.normalize(context.normalizer, observation)
            after = normalization.normalize(context.normalizer, after)
            action = jnp.clip(action, *context.action_range)
            return self._network.apply(params, observation, action, after)

        def step_rewards(params: Any, rates: Normalizer) -> jax.Array:
            mean, scale = normalization.moments(rates)
            step = (batch.observation, batch.action, batch.next_observation)
            return mean[0] + scale[0] * predict(params, *step)

        # Measure how well the batch's ended windows are predicted, then train.
        ends = ends_window(batch.reward, batch.ended)
        scored = ends & ~batch.faulty
        running = (state.open_reward, state.open_steps)
        before = step_rewards(state.network.params, state.rates)
        total, length, _ = window_sums(before, ends, running)
        rate = batch.reward / length
        metrics = goodness_of_fit(total / length, rate, scored & (length > 1))
        rates = normalization.update(
            state.rates, jnp.where(scored, rate, jnp.nan)[..., None]
        )
        num_steps, ring = batch.reward.shape[0], history.observation.shape[1]
        cursor = (history.cursor - num_steps) % ring
        trained = self._train(
            state.network, history, rates=rates, key=key, predict=predict
        )
        healthy, trained = learner.keep_if_finite(trained, state.network)
        # What the network does not explain of a payout is shared by the window's steps.
        reward = step_rewards(trained.params, rates)
        total, length, running = window_sums(reward, ends, running)
        share = jnp.where(scored, (batch.reward - total) / length, 0.0)
        share = at_window_end(share, ends)
        # Steps of the history, in earlier batches, of the window that goes on in this.
        age = (cursor - 1 - jnp.arange(ring)) % ring
        is_open = age[None] < state.open_steps[:, None]
        recorded = state.reward + jnp.where(is_open, share[0][:, None], 0.0)
        reward = reward + share
        reward = jnp.where(ends & (length == 1), batch.reward, reward)
        reward = jnp.where(batch.faulty, 0.0, reward)
        state = state.replace(
            network=trained,
            rates=rates,
            reward=write(recorded, reward, cursor),
            open_reward=running[0],
            open_steps=running[1],
        )
        # The NaNs that mark episodes without a valid return must stay.
        no_return = jnp.isnan(history.reward)
        decomposed = jnp.where(no_return, jnp.nan, state.reward)
        context = context.replace(
            rollout=batch.replace(reward=reward),
            history=history.replace(reward=decomposed),
        )
        return state, context, healthy, metrics

    def _train(
        self,
        network: Learner,
        history: History,
        *,
        rates: Normalizer,
        key: jax.Array,
        predict: Any,
    ) -> Learner:
        """Take gradient steps on windows drawn from the history.

        If all windows have a single step, no network is needed and no step is taken.
        The number of steps is a loop's bound, not a mask, so a vmapped batch of such
        runs saves the time too.
        """
        num_windows = self.decomposition_minibatch_size
        num_rows = self.decomposition_window_steps
        complete = windows(history)
        steps = complete.ends.shape[1]
        rings = history.observation, history.action, history.next_observation
        mean, scale = normalization.moments(rates)
        counts = jnp.cumsum(complete.ends.ravel())
        numbers = sum(ring.shape[-1] for ring in rings if ring is not None)
        parts = num_parts(num_windows, num_rows * numbers)

        def objective(params: Any, drawn: Any) -> jax.Array:
            env, position, weight, target = drawn
            # Windows and steps are one axis: with two, a CPU takes a third longer.
            index = (jnp.repeat(env, num_rows), position.ravel())
            output = predict(params, *jax.tree.map(lambda ring: ring[index], rings))
            predicted = jnp.sum(weight * output.reshape(weight.shape), axis=1)
            return jnp.mean((predicted - target) ** 2)

        def step(i: jax.Array, network: Learner) -> Learner:
            window_key, step_key = jax.random.split(keys[i])
            rank = jax.random.uniform(window_key, (num_windows,)) * counts[-1]
            index = jnp.searchsorted(counts, jnp.floor(rank).astype(jnp.int32), "right")
            env, end = jnp.divmod(jnp.minimum(index, counts.size - 1), steps)
            length = complete.length[env, end]
            offset, weight = sample_window_steps(step_key, length, num_rows)
            position = (history.cursor + end[:, None] - offset) % steps
            target = (complete.payout[env, end] / length - mean[0]) / scale[0]
            drawn = (env, position, weight, target)
            gradient = mean_gradient(
                jax.grad(objective), network.params, drawn, parts=parts
            )
            step_size = self.decomposition_learning_rate
            return learner.descend(
                network, gradient, learner.adam(), step_size=step_size
            )

        keys = jax.random.split(key, self.decomposition_updates)
        is_delayed = jnp.any(complete.ends & (complete.length > 1))
        return jax.lax.fori_loop(0, jnp.where(is_delayed, len(keys), 0), step, network)
