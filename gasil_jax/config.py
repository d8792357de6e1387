"""The settings of the algorithm: `Config` (static) and `Hyperparameters` (traced).

Defaults come from the paper's appendix, and where it gives none from OpenAI baselines,
on which the paper's code was built. Each field is declared with its allowed range.
"""

import contextlib
import dataclasses
import inspect
import math
import numbers
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from flax import struct

from gasil_jax import registry
from gasil_jax.errors import unknown

#: A factor that multiplies a hyperparameter, as a function of environment steps. Either
#: an Optax schedule (any pure function of the steps) or (steps, factor) points, linear
#: between them and constant beyond. Without points the factor is always 1.
Schedule = tuple[tuple[float, float], ...] | Callable[[Any], Any]


#: Counts and shapes are int32.
_LARGEST_COUNT = 2**31 - 1
#: All other numbers are float32.
_LARGEST_FLOAT = 3.4e38


class Range(NamedTuple):
    """The range of finite numbers that a field allows.

    Attributes:
      low: the lowest number.
      high: the highest number.
      excludes_low: whether `low` itself is not allowed.
      whole: whether only whole numbers are allowed.
    """

    low: float
    high: float = math.inf
    excludes_low: bool = False
    whole: bool = False

    def __contains__(self, value: object) -> bool:
        """Return whether a value is a number in the range; a bool is not."""
        # NumPy's integers are not `int`, but `bool` is.
        kind = numbers.Integral if self.whole else numbers.Real
        if not isinstance(value, kind) or isinstance(value, bool):
            return False
        try:
            number = float(value)
        except OverflowError:  # a whole number that is too large for a float
            return False
        if self.excludes_low:
            # JAX computes in float32, and takes its subnormal numbers as 0.
            single = np.float32(np.clip(number, -_LARGEST_FLOAT, _LARGEST_FLOAT))
            above = bool(single - self.low >= np.finfo(np.float32).tiny)
        else:
            above = number >= self.low
        return above and number <= self.high and math.isfinite(number)

    def __str__(self) -> str:
        if self.whole:
            return f"a whole number, {self.low:g} or more"
        least = f"{'more than ' * self.excludes_low}{self.low:g}"
        least += " in float32" if self.excludes_low else " or more"
        most = "finite" if math.isinf(self.high) else f"at most {self.high:g}"
        return f"{least} and {most}"


def number(
    default: float, low: float, high: float = math.inf, excludes_low: bool = False
) -> Any:
    """Declare a float field of `Hyperparameters` or of a class derived from it.

    Args:
      default: the default value.
      low: the lowest value.
      high: the highest value.
      excludes_low: whether the value must be more than `low`.
    """
    return _field(default, Range(low, high, excludes_low))


def _count(default: Any) -> Any:
    return _field(default, Range(1, whole=True))


def _field(default: Any, allowed: Range) -> Any:
    return dataclasses.field(default=default, metadata={"range": allowed})


class Hyperparameters(struct.PyTreeNode):
    """The numbers that may differ between the runs of one compiled program.

    They are a pytree, so a sweep is a `vmap` over its leaves.

    Two of them are counts, `discriminator_updates` and `buffer_steps`. The values in
    the config decide shapes and are upper limits: a run of a sweep may have smaller
    ones.

    An agent with further hyperparameters derives a class from this one, declares them
    with `number` and names the class in its `Imitation`.

    Attributes:
      learning_rate: Adam's step size for policy and value.
      learning_rate_decay: fraction of the learning rate that is lost, linearly, by the
        end of training: 1 anneals it to 0, and 0 keeps it constant.
      gamma: discount factor.
      gae_lambda: the lambda of generalized advantage estimation.
      clip_epsilon: PPO's clip range of the probability ratio.
      entropy_coefficient: weight of the policy's entropy (the paper's lambda).
      value_coefficient: weight of the value's squared error. It hardly matters, because
        the value has its own network, gradient clip and Adam.
      max_grad_norm: largest global norm of a gradient; the policy's and the value's
        gradients are clipped separately.
      initial_deviation: standard deviation of the untrained policy's actions.
      reward_clip: largest absolute value of a normalized reward (see normalize_rewards,
        without which it has no effect). If an episode is rewarded only at its end, the
        default clips most rewards to the same number: use 1e9, which clips none.
      alpha: scale of the discriminator's reward (paper, section 4.3).
      discriminator_learning_rate: Adam's step size for the discriminator.
      discriminator_updates: gradient steps of the discriminator in an iteration.
      discriminator_entropy_coefficient: weight of the entropy of the discriminator's
        output.
      buffer_steps: capacity of the good-trajectory buffer, in steps.
      imitation_weight: largest share of imitation in the policy's advantage, in
        ppo+gasil-adaptive.
      decomposition_learning_rate: Adam's step size for the network that decomposes
        rewards.
      behavior_cloning_coefficient: weight of the cloning loss of PPO+BC.
      sil_coefficient: weight of the loss of PPO+SIL.
      sil_value_coefficient: weight of the value's loss within PPO+SIL's loss.
    """

    learning_rate: float = number(3e-4, 0.0, excludes_low=True)
    learning_rate_decay: float = number(1.0, 0.0, 1.0)
    gamma: float = number(0.99, 0.0, 1.0)
    gae_lambda: float = number(0.95, 0.0, 1.0)
    clip_epsilon: float = number(0.2, 0.0, excludes_low=True)
    entropy_coefficient: float = number(0.0, 0.0)
    value_coefficient: float = number(1.0, 0.0)
    max_grad_norm: float = number(0.5, 0.0, excludes_low=True)
    initial_deviation: float = number(1.0, 0.0, excludes_low=True)
    reward_clip: float = number(10.0, 0.0, excludes_low=True)
    alpha: float = number(0.1, 0.0)
    discriminator_learning_rate: float = number(1e-4, 0.0, excludes_low=True)
    discriminator_updates: int = _count(5)
    discriminator_entropy_coefficient: float = number(1e-3, 0.0)
    buffer_steps: int = _count(1000)
    imitation_weight: float = number(0.7, 0.0, 1.0)
    decomposition_learning_rate: float = number(1e-3, 0.0, excludes_low=True)
    behavior_cloning_coefficient: float = number(0.1, 0.0)
    sil_coefficient: float = number(0.1, 0.0)
    sil_value_coefficient: float = number(0.01, 0.0)


@dataclasses.dataclass(frozen=True)
class Config:
    """The settings that change array shapes, loop counts or the program; hashable.

    `Config(...)` takes the fields below. `replace` also takes those of
    `hyperparameters`: ``Config(agent="gasil").replace(alpha=0.2)``.

    Attributes:
      agent: name of the agent: ppo, ppo+bc, ppo+sil, gasil, ppo+gasil,
        ppo+gasil-adaptive, ppo+bonus, gail, or your own as MODULE:NAME.
      total_steps: environment steps per seed, rounded up to whole batches.
      num_envs: number of environments that each seed steps in parallel.
      batch_steps: environment steps in an iteration, summed over all environments (the
        paper's horizon).
      num_epochs: passes of PPO over a batch.
      minibatch_size: steps in one gradient step of PPO.
      hidden_sizes: widths of the tanh layers, in the policy and in the value.
      bonus: form of the discriminator's reward: softplus (-log D, the paper's), logit,
        dail or centered.
      imitation_rule: how ppo+gasil-adaptive weights imitation in the policy's
        advantage: by the "agreement" of the two advantages, by the "gap" between the
        buffer's returns and the policy's, by "both", or by neither, "fixed".
      discriminator_minibatch_size: steps of the policy, and as many good steps, in one
        gradient step of the discriminator.
      discriminator_hidden_sizes: widths of the discriminator's tanh layers.
      behavior_cloning_updates: gradient steps on PPO+BC's cloning loss in an iteration.
      behavior_cloning_minibatch_size: good steps in one gradient step on PPO+BC's
        cloning loss.
      sil_updates: gradient steps on PPO+SIL's loss in an iteration.
      sil_minibatch_size: replayed steps in one gradient step on PPO+SIL's loss.
      sil_buffer_steps: capacity of PPO+SIL's replay buffer, in steps.
      discriminator_gradient_penalty: weight of a gradient penalty on the
        discriminator, as in WGAN-GP: at points between good pairs and the policy's, the
        norm of its gradient with respect to its input is pulled to 1.
      discriminator_normalizes_actions: whether the discriminator sees actions in units
        of the batch's mean and standard deviation; otherwise as they are.
      buffer_episodes: largest number of episodes in the good-trajectory buffer, besides
        its capacity in steps; None for no limit.
      buffer_discounts: whether the good-trajectory buffer ranks episodes by their
        discounted return, as the paper does; otherwise by the undiscounted one.
      sample_by_return: whether good steps are drawn with weights exp(R / s), with R the
        return of their episode and s its standard deviation over the buffer's steps;
        otherwise uniformly.
      learning_rate_schedule: factor that multiplies the learning rate, over environment
        steps: STEPS FACTOR pairs, linear between them (from Python also any Optax
        schedule).
      clip_epsilon_schedule: factor that multiplies PPO's clip range, given in the same
        way.
      alpha_schedule: factor that multiplies alpha, given in the same way. On Humanoid
        the paper's alpha is 0 for 2M steps and then rises to its full value at 3M. That
        is 2e6 0 3e6 1 on the command line and ((2e6, 0), (3e6, 1)) in Python.
      normalize_rewards: whether to divide PPO's rewards by the standard deviation of
        their running discounted sum (as in OpenAI baselines' ppo2). Alpha is then in
        that unit, not in the environment's. It has no effect on the agents gasil and
        gail, which do not use the environment's reward.
      decompose_rewards: whether PPO learns from a reward for each step, which a network
        learns from the delayed sums, instead of from the delayed reward itself.
      decomposition_updates: gradient steps in an iteration of the network that
        decomposes rewards.
      decomposition_minibatch_size: windows in one gradient step of the network that
        decomposes rewards. A window is the steps between two payouts.
      decomposition_window_steps: largest number of steps that represent a window in
        such a gradient step. Of a longer window, this many are drawn at random.
      decomposition_history_episodes: length of the history that windows are drawn from,
        in episodes of full length; a batch is added to it. If rewards come only at the
        end of an episode, 1 leaves few windows.
      decomposition_hidden_sizes: widths of the tanh layers of the network that
        decomposes rewards.
      stagger_episodes: whether each environment's first episode begins at a random age,
        so that a batch holds steps from all parts of an episode. Otherwise all begin at
        age 0 and, if none ends early, a batch holds the same few steps of each episode.
      expert: expert that GAIL imitates: minari:NAME for a Minari data set, or an .npz
        file with the arrays "observation" and "action".
      max_episode_steps: number of steps after which an episode is truncated; None takes
        the environment's own limit, or 1000 if it has none.
      hyperparameters: numbers that `make_train` also takes as traced arguments. They do
        not change the compiled program, except for buffer_steps and
        discriminator_updates.
    """

    agent: str = "ppo+gasil"
    total_steps: int = _count(1_000_000)
    num_envs: int = _count(16)
    batch_steps: int = _count(2048)
    num_epochs: int = _count(10)
    minibatch_size: int = _count(64)
    hidden_sizes: tuple[int, ...] = _count((64, 64))
    bonus: str = "softplus"
    imitation_rule: str = "both"
    discriminator_minibatch_size: int = _count(128)
    discriminator_hidden_sizes: tuple[int, ...] = _count((100, 100))
    behavior_cloning_updates: int = _count(10)
    behavior_cloning_minibatch_size: int = _count(64)
    sil_updates: int = _count(10)
    sil_minibatch_size: int = _count(512)
    sil_buffer_steps: int = _count(50_000)
    discriminator_gradient_penalty: float = number(0.0, 0.0)
    discriminator_normalizes_actions: bool = False
    buffer_episodes: int | None = _count(None)
    buffer_discounts: bool = True
    sample_by_return: bool = False
    learning_rate_schedule: Schedule = ()
    clip_epsilon_schedule: Schedule = ()
    alpha_schedule: Schedule = ()
    normalize_rewards: bool = False
    decompose_rewards: bool = False
    decomposition_updates: int = _count(20)
    decomposition_minibatch_size: int = _count(64)
    decomposition_window_steps: int = _count(32)
    decomposition_history_episodes: int = _count(1)
    decomposition_hidden_sizes: tuple[int, ...] = _count((100, 100))
    stagger_episodes: bool = True
    expert: str | None = None
    max_episode_steps: int | None = _count(None)
    hyperparameters: Hyperparameters = dataclasses.field(
        default_factory=Hyperparameters
    )

    def __post_init__(self) -> None:
        """Give the hyperparameters the class that the agent declares."""
        # `validate` reports an unknown agent.
        with contextlib.suppress(ValueError):
            own = hyperparameters_of(self.agent)
            values = self.hyperparameters
            if isinstance(values, Hyperparameters) and type(values) is not own:
                kept = {x: y for x, y in vars(values).items() if x in _names(own)}
                object.__setattr__(self, "hyperparameters", own(**kept))

    @staticmethod
    def types_of(values: Mapping[str, Any]) -> dict[str, type]:
        """Return the types of fields that depend on the values of other fields.

        Raises:
          ValueError: if the values name no agent.
        """
        agent = values.get("agent", Config.agent)
        return {"hyperparameters": hyperparameters_of(agent)}

    @property
    def num_steps(self) -> int:
        """Steps of each environment in an iteration."""
        return self.batch_steps // self.num_envs

    @property
    def num_minibatches(self) -> int:
        """Gradient steps of PPO in an epoch."""
        return self.batch_steps // self.minibatch_size

    @property
    def num_iterations(self) -> int:
        """Iterations of Algorithm 1 in a run."""
        return math.ceil(self.total_steps / self.batch_steps)

    def replace(self, **changes: Any) -> "Config":
        """Return a copy with changed fields, including those of `hyperparameters`.

        Raises:
          ValueError: if a name is no field and no hyperparameter of the agent.
        """
        swept = {name: changes.pop(name) for name in set(changes) - set(_names(Config))}
        changed = dataclasses.replace(self, **changes)
        if not swept:
            return changed
        names = _names(type(changed.hyperparameters))
        for name in swept:
            if name not in names:
                hyperparameters_of(changed.agent)  # If it is unknown, this says so.
                raise ValueError(unknown("setting", name, (*_names(Config), *names)))
        hyperparameters = changed.hyperparameters.replace(**swept)
        return dataclasses.replace(changed, hyperparameters=hyperparameters)


#: Columns of a sweep's tables, whose names no hyperparameter may have.
_COLUMNS = frozenset(
    "point seed mean worst_seed diverged diverged_seeds final_return final_length "
    "final_evaluation".split()
)


def _names(kind: type) -> tuple[str, ...]:
    """Return the names of a dataclass' fields."""
    return tuple(field.name for field in dataclasses.fields(kind))


def hyperparameters_of(agent: Any) -> type[Hyperparameters]:
    """Return the class of an agent's hyperparameters.

    Args:
      agent: the agent's name, see `registry.find`.

    Raises:
      ValueError: if there is no such agent, if it declares a hyperparameter without
        `number` or with a name that is taken, or if its `fields` name one that does not
        exist.
    """
    imitation = registry.find(agent)
    kind = imitation.hyperparameters
    if not (isinstance(kind, type) and issubclass(kind, Hyperparameters)):
        raise ValueError(
            f"agent {agent!r} has hyperparameters {kind!r}: they must be a class that "
            "is derived from gasil_jax.Hyperparameters"
        )
    for parent in kind.__mro__[: kind.__mro__.index(Hyperparameters)]:
        for name in inspect.get_annotations(parent):
            taken = hasattr(Hyperparameters, name) or name in _names(Config)
            if taken or name in _COLUMNS:
                raise ValueError(
                    f"agent {agent!r} has a hyperparameter {name!r}, a name that is "
                    "taken: it must be a new one"
                )
            if name not in ranges(kind):
                raise ValueError(
                    f"agent {agent!r} has a hyperparameter {name!r} without a range: "
                    "it must be declared with gasil_jax.config.number"
                )
    for name in imitation.fields or ():
        if not hasattr(kind, name) and not hasattr(Config, name):
            raise ValueError(
                f"agent {agent!r} says that it uses {name!r}: it must be the name of a "
                "field of Config or of the agent's hyperparameters"
            )
    return kind


def own_names(agent: str) -> tuple[str, ...]:
    """Return the names of the hyperparameters that only this agent has.

    Raises:
      ValueError: see `hyperparameters_of`.
    """
    return _names(hyperparameters_of(agent))[len(_names(Hyperparameters)) :]


def ranges(kind: type) -> Mapping[str, Range]:
    """Return the allowed range of each numeric field of a settings class, by name."""
    return {
        field.name: field.metadata["range"]
        for field in dataclasses.fields(kind)
        if "range" in field.metadata
    }


def validate(config: Config) -> None:
    """Check that every value of a config is allowed.

    Raises:
      ValueError: if a value is not allowed; the message names the value and the range.
    """
    for field in dataclasses.fields(Config):
        value = getattr(config, field.name)
        if isinstance(field.default, bool) and not isinstance(value, bool):
            raise _refusal(field.name, value, "True or False")
        if isinstance(field.default, str) and not isinstance(value, str):
            raise _refusal(field.name, value, "a string")
    if not isinstance(config.expert, str | None):
        raise _refusal("expert", config.expert, "a string or None")
    hyperparameters_of(config.agent)
    _validate_sizes(config)
    for name in ("num_envs", "minibatch_size"):
        _validate_divides(name, getattr(config, name), config.batch_steps)
    for name in ("learning_rate_schedule", "clip_epsilon_schedule", "alpha_schedule"):
        _validate_schedule(name, getattr(config, name), config.total_steps)
    validate_hyperparameters(config, config.hyperparameters)


def validate_hyperparameters(config: Config, hyperparameters: Hyperparameters) -> None:
    """Check that the hyperparameters of one run are allowed.

    Args:
      config: the config of the run, whose counts are upper limits.
      hyperparameters: scalars. Of those that are traced only the shapes are checked,
        because they have no value yet.

    Raises:
      ValueError: if a value is not allowed; the message names the value and the range.
    """
    if not isinstance(hyperparameters, Hyperparameters):
        raise _refusal("hyperparameters", hyperparameters, "Hyperparameters")
    for name, allowed in ranges(type(hyperparameters)).items():
        value = getattr(hyperparameters, name)
        if shape := getattr(value, "shape", ()):
            raise ValueError(
                f"{name} has shape {shape}: it must be a single number (to train with "
                "several, use jax.vmap)"
            )
        if isinstance(value, jax.core.Tracer):
            continue
        value = _unboxed(value, allowed)
        _validate_number(name, value, allowed)
        most = getattr(config.hyperparameters, name, value)
        if not allowed.whole or isinstance(most, jax.core.Tracer):
            continue
        if value > (most := _unboxed(most, allowed)):
            raise ValueError(
                f"{name} is {value}: it must be at most the config's, {most}"
            )


def _unboxed(value: Any, allowed: Range) -> Any:
    """Return an array of shape () as a Python number, and other values unchanged.

    The runs of a sweep have all their hyperparameters as float32, counts too, so a
    whole number that a count allows becomes an int.
    """
    if not isinstance(value, np.generic | np.ndarray | jax.Array):
        return value
    number = value.item()
    whole = allowed.whole and isinstance(number, float) and number.is_integer()
    return int(number) if whole else number


def _refusal(name: str, value: Any, allowed: object) -> ValueError:
    # The repr of NumPy's numbers also names their type.
    is_number = isinstance(value, numbers.Number)
    # The repr of an array may have several lines.
    shown = value if is_number else " ".join(repr(value).split())
    return ValueError(f"{name} is {shown}: it must be {allowed}")


def _validate_number(
    name: str, value: Any, allowed: Range, most: float = _LARGEST_COUNT
) -> None:
    if isinstance(value, str):
        raise _refusal(name, value, "a number")
    most = most if allowed.whole else _LARGEST_FLOAT
    is_real = isinstance(value, numbers.Real)
    if is_real and value > most and math.isinf(allowed.high):
        raise _refusal(name, value, f"{allowed}, at most {most:g}")
    if value not in allowed:
        raise _refusal(name, value, allowed)


def _validate_sizes(config: Config) -> None:
    for name, allowed in ranges(Config).items():
        value = getattr(config, name)
        if value is None and getattr(Config, name) is None:
            continue
        if name.endswith("_sizes"):
            if not isinstance(value, tuple):
                raise _refusal(name, value, "a tuple of sizes")
            for size in value:
                _validate_number(name, size, allowed)
        elif name != "total_steps":
            _validate_number(name, value, allowed)
    # The number of iterations is an int32.
    most = _LARGEST_COUNT * config.batch_steps
    allowed = ranges(Config)["total_steps"]
    _validate_number("total_steps", config.total_steps, allowed, most)


def _validate_divides(name: str, size: int, batch_steps: int) -> None:
    if batch_steps % size == 0:
        return
    root = math.isqrt(batch_steps)
    small = [n for n in range(1, root + 1) if batch_steps % n == 0]
    divisors = [*small, *(batch_steps // n for n in reversed(small))]
    closest = min(divisors, key=lambda n: abs(n - size))
    raise ValueError(
        f"{name} is {size}, which does not divide batch_steps {batch_steps}: "
        f"the nearest that does is {closest}"
    )


def _validate_schedule(name: str, points: Any, total_steps: int) -> None:
    if callable(points):
        _validate_function(name, points, total_steps)
        return
    pairs = "(steps, factor) points"
    if not isinstance(points, tuple) or not all(
        isinstance(point, tuple) and len(point) == 2 for point in points
    ):
        raise _refusal(name, points, pairs)
    for number in (number for point in points for number in point):
        _validate_number(name, number, Range(0.0))
    steps = [point[0] for point in points]
    if steps != sorted(set(steps)):
        raise _refusal(name, points, f"{pairs}, steps increasing")


def _validate_function(
    name: str, function: Callable[[Any], Any], total_steps: int
) -> None:
    """Check the factors that a schedule gives at the start and the end of training."""
    for step in (0, total_steps):
        try:
            factor = function(jax.numpy.float32(step))
            if isinstance(factor, jax.core.Tracer):
                return
            number = float(factor)
        except Exception as error:
            why = f"{type(error).__name__}: {error}".partition("\n")[0]
            raise ValueError(f"{name} gives no number at step {step}: {why}") from None
        _validate_number(f"{name}({step})", number, Range(0.0))
