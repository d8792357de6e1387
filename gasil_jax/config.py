"""The settings of training: how a setting is declared, and `Config`, those of PPO.

Defaults come from the paper's appendix, and where it gives none from OpenAI baselines,
on which the paper's code was built. Every setting of PPO, an agent or a reward model is
a field that is declared here with what it allows: `number`, `count`, `switch`,
`choice`, `widths`, `schedule` or `text`.
"""

import dataclasses
import math
import numbers
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from flax import struct

from gasil_envs import user_code
from gasil_jax.errors import refusal, unknown

#: A factor that multiplies a number, as a function of environment steps. Either an
#: Optax schedule (any pure function of the steps) or (steps, factor) points, linear
#: between them and constant beyond. Without points the factor is always 1.
Schedule = tuple[tuple[float, float], ...] | Callable[[Any], Any]
#: What follows the name of a number in the name of its schedule.
SCHEDULE_SUFFIX = "_schedule"

#: Counts are int32, and all other numbers float32.
_LARGEST_COUNT, _LARGEST_FLOAT = 2**31 - 1, 3.4e38
#: Numbers that are smaller are 0 in float32.
_SMALLEST_FLOAT = 1.2e-38


class Range(NamedTuple):
    """The range of finite numbers that a field allows."""

    low: float
    high: float = _LARGEST_FLOAT
    excludes_low: bool = False  # Whether `low` itself is not allowed.
    whole: bool = False  # Whether only whole numbers are allowed.

    def __contains__(self, value: Any) -> bool:
        kind: Any = numbers.Integral if self.whole else numbers.Real
        if not isinstance(value, kind) or isinstance(value, bool):
            return False
        is_above = value > self.low if self.excludes_low else value >= self.low
        if self.excludes_low and self.low == 0:
            is_above = value >= _SMALLEST_FLOAT
        return bool(is_above and value <= self.high)

    def __str__(self) -> str:
        if self.whole:
            most = "" if self.high >= _LARGEST_COUNT else f", at most {self.high:.0f}"
            return f"a whole number, {self.low:g} or more{most}"
        least = (
            f"more than {self.low:g}" if self.excludes_low else f"{self.low:g} or more"
        )
        least += " in float32" if self.excludes_low else ""
        most = f"at most {self.high:g}" if self.high < _LARGEST_FLOAT else "finite"
        return f"{least} and {most}"


_COUNT = Range(1, _LARGEST_COUNT, whole=True)
#: What checks the value of a field: a range, or a function of its name and value.
Check = Range | Callable[[str, Any], None]


def validate_switch(name: str, value: Any) -> None:
    """Raise `ValueError` unless a value is true or false."""
    if not isinstance(value, bool):
        raise refusal(name, value, "True or False")


def validate_key(key: Any) -> None:
    """Raise `ValueError` unless this is a single random key, of either kind."""
    dtype = getattr(key, "dtype", None)
    typed = dtype is not None and jax.numpy.issubdtype(dtype, jax.dtypes.prng_key)
    if not typed and dtype != jax.numpy.uint32:
        raise refusal("key", key, "like jax.random.key(0)")
    if typed and key.shape:
        raise ValueError(
            f"key has shape {key.shape}: it must be a single key (to train with "
            "several, use jax.vmap)"
        )


def validate_state(state: Any) -> None:
    """Raise `ValueError` unless this is the training state of one run."""
    if not hasattr(state, "iteration"):
        raise refusal("state", state, "a TrainState, as gasil_jax.init returns")
    if shape := jax.numpy.shape(state.iteration):
        raise ValueError(
            f"state is a batch of {shape[0]} states: take one of them, or jax.vmap this"
        )


def validate_number(name: str, value: Any, allowed: Range) -> None:
    """Raise `ValueError` unless a value is a number in the range, or traced."""
    if shape := getattr(value, "shape", ()):
        raise ValueError(
            f"{name} has shape {shape}: it must be a single number (to train with "
            "several, use jax.vmap)"
        )
    if isinstance(value, jax.core.Tracer):
        return
    is_array = isinstance(value, np.ndarray | jax.Array)
    if is_array and jax.numpy.issubdtype(value.dtype, np.number):
        value = value.item()
    if value not in allowed:
        raise refusal(name, value, "a number" if isinstance(value, str) else allowed)


def _validate_widths(name: str, value: Any) -> None:
    if not isinstance(value, tuple):
        raise refusal(name, value, "a tuple of sizes")
    for size in value:
        validate_number(name, size, _COUNT)


def _validate_text(name: str, value: Any) -> None:
    if not isinstance(value, str | None):
        raise refusal(name, value, "a string or None")


def _validate_schedule(name: str, schedule: Any) -> None:
    """Check points, or the factor of a function at the start of training."""
    if callable(schedule):
        what = f"{name} gives no number at step 0"
        with user_code.refused(what), jax.ensure_compile_time_eval():
            factor = schedule(jax.numpy.float32(0))
            factor = factor if isinstance(factor, jax.core.Tracer) else float(factor)
        validate_number(f"{name}(0)", factor, Range(0.0))
        return
    form = "(steps, factor) points, steps increasing"
    pairs = schedule if isinstance(schedule, tuple) else (None,)
    if not all(isinstance(point, tuple) and len(point) == 2 for point in pairs):
        raise refusal(name, schedule, form)
    for number in (number for point in pairs for number in point):
        validate_number(name, number, Range(0.0))
    steps = [point[0] for point in pairs]
    if steps != sorted(set(steps)):
        raise refusal(name, schedule, form)


def number(
    default: float,
    low: float,
    high: float = _LARGEST_FLOAT,
    *,
    excludes_low: bool = False,
) -> Any:
    """Declare a number from low to high, a traced leaf: each run may have its own.

    With `excludes_low` it must be more than `low`.
    """
    return _field(default, Range(low, high, excludes_low), traced=True)


def count(default: int | None, most: float = _LARGEST_COUNT) -> Any:
    """Declare a whole number from 1 on, or None if that is the default."""
    return _field(default, Range(1, most, whole=True))


def widths(*default: int) -> Any:
    """Declare the widths of a network's hidden layers, a tuple."""
    return _field(default, _validate_widths)


def switch(default: bool) -> Any:
    """Declare a setting that is true or false."""
    return _field(default, validate_switch)


def choice(default: str, allowed: Iterable[str]) -> Any:
    """Declare a setting that is one of several names."""
    names = tuple(allowed)

    def check(name: str, value: Any) -> None:
        if not isinstance(value, str) or value not in names:
            raise ValueError(unknown(name, value, names))

    return _field(default, check)


def schedule() -> Any:
    """Declare NAME_schedule, which multiplies the number NAME."""
    return _field((), _validate_schedule)


def text(default: str | None = None) -> Any:
    """Declare a name or a path, or None."""
    return _field(default, _validate_text)


def _field(default: Any, check: Check, *, traced: bool = False) -> Any:
    metadata = {"pytree_node": traced, "check": check}
    return dataclasses.field(default=default, metadata=metadata)


class Config(struct.PyTreeNode):
    """The settings of the training loop and of PPO.

    It is a pytree of its numbers. They are traced: a batch of runs in one compiled
    program may have different ones. All else decides shapes or the program.

    Attributes:
      total_steps: environment steps per seed, rounded up to whole batches.
      num_envs: number of environments that each seed steps in parallel.
      batch_steps: environment steps in an iteration, summed over all environments (the
        paper's horizon).
      num_epochs: passes of PPO over a batch.
      minibatch_size: steps in one gradient step of PPO.
      hidden_sizes: widths of the hidden layers, in the policy and in the value.
      activation: activation function of the hidden layers: tanh, relu or swish.
      layer_norm: whether each hidden layer is normalized before its activation.
      policy_components: number of Gaussians in the policy. If it is more than 1, the
        policy is a mixture whose weights and means depend on the state. A mixture can
        keep several ways to succeed. Only 1 for discrete actions.
      stagger_episodes: whether each environment's first episode begins at a random age,
        so that a batch holds steps from all parts of an episode. Otherwise all begin at
        age 0 and, if none ends early, a batch holds the same few steps of each episode.
      learning_rate: Adam's step size for policy and value.
      learning_rate_decay: fraction of the learning rate that is lost, linearly, by the
        end of training: 1 anneals it to 0, and 0 keeps it constant.
      learning_rate_schedule: factor that multiplies the learning rate, over environment
        steps: STEPS FACTOR pairs, linear between them (from Python also any Optax
        schedule).
      gamma: discount factor.
      gae_lambda: the lambda of generalized advantage estimation.
      clip_epsilon: PPO's clip range of the probability ratio.
      clip_epsilon_schedule: factor that multiplies PPO's clip range, given in the same
        way as that of the learning rate.
      entropy_coefficient: weight of the policy's entropy (the paper's lambda).
      max_grad_norm: largest global norm of a gradient; the policy's and the value's
        gradients are clipped separately.
      initial_std: standard deviation of the untrained policy's actions.
    """

    # More than an int32: what is counted are iterations.
    total_steps: int = count(1_000_000, most=2**60)
    num_envs: int = count(16)
    batch_steps: int = count(2048)
    num_epochs: int = count(10)
    minibatch_size: int = count(64)
    hidden_sizes: tuple[int, ...] = widths(64, 64)
    activation: str = choice("tanh", ("tanh", "relu", "swish"))
    layer_norm: bool = switch(False)
    policy_components: int = count(1)
    stagger_episodes: bool = switch(True)
    learning_rate: float = number(3e-4, 0.0, excludes_low=True)
    learning_rate_decay: float = number(1.0, 0.0, 1.0)
    learning_rate_schedule: Schedule = schedule()
    gamma: float = number(0.99, 0.0, 1.0)
    gae_lambda: float = number(0.95, 0.0, 1.0)
    clip_epsilon: float = number(0.2, 0.0, excludes_low=True)
    clip_epsilon_schedule: Schedule = schedule()
    entropy_coefficient: float = number(0.0, 0.0)
    max_grad_norm: float = number(0.5, 0.0, excludes_low=True)
    initial_std: float = number(1.0, 0.0, excludes_low=True)

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


def names(kind: Any) -> tuple[str, ...]:
    """Return the names of the settings of a class, or of an instance."""
    return tuple(field.name for field in dataclasses.fields(kind))


def traced_names(kind: Any) -> tuple[str, ...]:
    """Return the names of the numbers that are traced."""
    return tuple(x.name for x in dataclasses.fields(kind) if x.metadata["pytree_node"])


def ranges(kind: Any) -> Mapping[str, Range]:
    """Return the allowed range of each number and count of a class, by name."""
    checks = {x.name: x.metadata["check"] for x in dataclasses.fields(kind)}
    return {name: check for name, check in checks.items() if isinstance(check, Range)}


def validate(settings: Any) -> None:
    """Raise `ValueError` unless a part's settings are allowed, as far as not traced."""
    for field in dataclasses.fields(settings):
        name, value = field.name, getattr(settings, field.name)
        if "check" not in field.metadata:
            raise ValueError(
                f"setting {name!r} has no range: it must be declared with "
                "gasil_jax.config.number, or another function there"
            )
        check = field.metadata["check"]
        if not isinstance(check, Range):
            check(name, value)
        elif not (value is None and field.default is None):
            validate_number(name, value, check)


def validate_config(config: Config) -> None:
    """Raise `ValueError` unless a config is allowed, each value and all together."""
    validate(config)
    for name in ("num_envs", "minibatch_size"):
        size, batch_steps = getattr(config, name), config.batch_steps
        if batch_steps % size:
            most = min(size, batch_steps)
            near = (n for x in range(most) for n in (most - x, most + x))
            nearest = next(n for n in near if batch_steps % n == 0)
            raise ValueError(
                f"{name} is {size}, which does not divide batch_steps {batch_steps}: "
                f"the nearest that does is {nearest}"
            )
