"""What a run is: `Config` (static, decides shapes) and `Hyperparameters` (traced).

Defaults are the paper's appendix where it gives a value, else OpenAI baselines', on
which the paper's code was built. Each field stands beside the values that it may have.
"""

import dataclasses
import math
import numbers
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from flax import struct

from gasil_jax.errors import unknown

#: The factor that a hyperparameter is multiplied by, over environment steps: an
#: Optax schedule (any pure function of the steps), or (steps, factor) points, linear
#: between them and constant beyond; no points are 1 throughout.
Schedule = tuple[tuple[float, float], ...] | Callable[[Any], Any]


class Range(NamedTuple):
    """The finite numbers that a field may have.

    Attributes:
      low: the lowest.
      high: the highest.
      excludes_low: whether the lowest itself is not allowed.
      whole: whether only whole numbers are.
    """

    low: float
    high: float = math.inf
    excludes_low: bool = False
    whole: bool = False

    def __contains__(self, value: object) -> bool:
        """Whether a number, no bool, is in the range."""
        # NumPy's whole numbers are no int, and a bool is one.
        kind = numbers.Integral if self.whole else numbers.Real
        if not isinstance(value, kind) or isinstance(value, bool):
            return False
        number = float(value)
        above = number > self.low if self.excludes_low else number >= self.low
        return above and number <= self.high and math.isfinite(number)

    def __str__(self) -> str:
        if self.whole:
            return f"a whole number, {self.low:g} or more"
        least = f"{'more than ' * self.excludes_low}{self.low:g}"
        least += "" if self.excludes_low else " or more"
        most = "finite" if math.isinf(self.high) else f"at most {self.high:g}"
        return f"{least} and {most}"


def _number(
    default: float, low: float, high: float = math.inf, excludes_low: bool = False
) -> Any:
    return _field(default, Range(low, high, excludes_low))


def _count(default: Any) -> Any:
    return _field(default, Range(1, whole=True))


def _field(default: Any, allowed: Range) -> Any:
    return dataclasses.field(default=default, metadata={"range": allowed})


class Hyperparameters(struct.PyTreeNode):
    """Every number that can be swept: a pytree, so a sweep is a `vmap` over leaves.

    Two counts are among them. The configuration's own value of these decides shapes and
    is the most that a run can have; a member of a sweep may have less.
    """

    learning_rate: float = _number(3e-4, 0.0, excludes_low=True)
    """Adam's step size for policy and value."""
    learning_rate_decay: float = _number(1.0, 0.0, 1.0)
    """Share of the learning rate that is gone, linearly, at the end of training: 1
    anneals to 0, 0 keeps it constant."""
    gamma: float = _number(0.99, 0.0, 1.0)
    """Discount factor."""
    gae_lambda: float = _number(0.95, 0.0, 1.0)
    """The lambda of generalized advantage estimation."""
    clip_epsilon: float = _number(0.2, 0.0, excludes_low=True)
    """PPO's clip range of the probability ratio."""
    entropy_coefficient: float = _number(0.0, 0.0)
    """The paper's lambda, weight of the policy's entropy."""
    value_coefficient: float = _number(1.0, 0.0)
    """Weight of the squared error of the value. The value has a network, gradient clip
    and Adam of its own, so it hardly matters."""
    max_grad_norm: float = _number(0.5, 0.0, excludes_low=True)
    """Gradients are scaled down to this global norm, the policy's and the value's each
    for itself."""
    alpha: float = _number(0.1, 0.0)
    """Scale of the discriminator's reward (paper, section 4.3)."""
    discriminator_learning_rate: float = _number(1e-4, 0.0, excludes_low=True)
    """Adam's step size for the discriminator."""
    discriminator_updates: int = _count(5)
    """Gradient steps of the discriminator an iteration."""
    discriminator_entropy_coefficient: float = _number(1e-3, 0.0)
    """Weight of the entropy of D's output."""
    buffer_steps: int = _count(1000)
    """Steps that the good-trajectory buffer keeps."""
    behavior_cloning_coefficient: float = _number(0.1, 0.0)
    """Weight of the cloning loss of PPO+BC."""
    sil_coefficient: float = _number(0.1, 0.0)
    """Weight of the loss of PPO+SIL."""
    sil_value_coefficient: float = _number(0.01, 0.0)
    """Weight of the value's part in it."""


@dataclasses.dataclass(frozen=True)
class Config:
    """Everything that changes shapes, loop counts or the program; hashable."""

    agent: str = "ppo+gasil"
    """Name of the agent, see `gasil_jax.agents()`."""
    total_steps: int = _count(1_000_000)
    """Environment steps of a seed; rounded up to whole batches."""
    num_envs: int = _count(16)
    """Environments that a seed steps at once."""
    batch_steps: int = _count(2048)
    """Environment steps in an iteration, over all environments (the paper's
    horizon)."""
    num_epochs: int = _count(10)
    """Passes of PPO over a batch."""
    minibatch_size: int = _count(64)
    """Steps in one gradient step of PPO."""
    hidden_sizes: tuple[int, ...] = _count((64, 64))
    """Widths of the tanh layers of the policy and of the value."""
    discriminator_minibatch_size: int = _count(128)
    """Policy steps, and as many good steps, in a gradient step of the
    discriminator."""
    discriminator_hidden_sizes: tuple[int, ...] = _count((100, 100))
    """Widths of the discriminator's tanh layers."""
    behavior_cloning_updates: int = _count(10)
    """Gradient steps of PPO+BC's own an iteration."""
    behavior_cloning_minibatch_size: int = _count(64)
    """Good steps in each."""
    sil_updates: int = _count(10)
    """Gradient steps of PPO+SIL's own an iteration."""
    sil_minibatch_size: int = _count(512)
    """Replayed steps in each."""
    sil_buffer_steps: int = _count(50_000)
    """Capacity of PPO+SIL's replay, in steps."""
    learning_rate_schedule: Schedule = ()
    """Factor over environment steps that the learning rate is multiplied by: STEPS
    FACTOR pairs, linear between them (from Python also any Optax schedule)."""
    clip_epsilon_schedule: Schedule = ()
    """The same for PPO's clip range."""
    alpha_schedule: Schedule = ()
    """The same for alpha. The paper's rule for Humanoid, 0 for 2M steps and then up to
    alpha until 3M, is ((2e6, 0), (3e6, 1))."""
    normalize_rewards: bool = False
    """Whether PPO's rewards are divided by the standard deviation of their running
    discounted sum (OpenAI baselines' ppo2). Alpha is in that unit then, not in the
    environment's. Agents gasil and gail have no such reward."""
    stagger_episodes: bool = True
    """Whether each environment's first episode begins at an age drawn from the whole
    episode, so that a batch holds steps of all its parts. Without it environments that
    never end early stay in lock-step for the whole run."""
    expert: str | None = None
    """What GAIL imitates: an .npz file with arrays "observation" and "action", or
    "minari:" and the name of a data set."""
    max_episode_steps: int | None = _count(None)
    """An episode is truncated after so many steps; None takes the environment's own
    limit, or 1000 if it has none."""
    hyperparameters: Hyperparameters = dataclasses.field(
        default_factory=Hyperparameters
    )
    """The numbers that can be swept; `make_train` can replace them under a trace."""

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
        """A copy with some fields changed, of its own or of its hyperparameters."""
        own = {field.name for field in dataclasses.fields(self)}
        swept = {name: changes.pop(name) for name in set(changes) - own}
        if swept:
            hyperparameters = changes.get("hyperparameters", self.hyperparameters)
            changes["hyperparameters"] = hyperparameters.replace(**swept)
        return dataclasses.replace(self, **changes)


def ranges(kind: type) -> Mapping[str, Range]:
    """Which numbers each field of `Config` or `Hyperparameters` may have, by name."""
    return {
        field.name: field.metadata["range"]
        for field in dataclasses.fields(kind)
        if "range" in field.metadata
    }


def validate(config: Config, agents: Sequence[str]) -> None:
    """Raise `ValueError`, naming the value and what is allowed, for a bad config.

    Args:
      config: what to check. Hyperparameters that are JAX arrays are not looked at:
        they may be traced.
      agents: the registered agents' names.
    """
    if config.agent not in agents:
        raise ValueError(unknown("agent", config.agent, agents))
    _validate_sizes(config)
    for name in ("normalize_rewards", "stagger_episodes"):
        if not isinstance(value := getattr(config, name), bool):
            raise ValueError(f"{name} is {value!r}: it must be True or False")
    for name in ("num_envs", "minibatch_size"):
        _validate_divides(name, getattr(config, name), config.batch_steps)
    for name in ("learning_rate_schedule", "clip_epsilon_schedule", "alpha_schedule"):
        _validate_schedule(name, getattr(config, name))
    for name, allowed in ranges(Hyperparameters).items():
        value = getattr(config.hyperparameters, name)
        if isinstance(value, str):
            raise ValueError(f"{name} is {value!r}: it must be a number")
        if isinstance(value, numbers.Real) and value not in allowed:
            raise ValueError(f"{name} is {value}: it must be {allowed}")


def _validate_sizes(config: Config) -> None:
    for name, allowed in ranges(Config).items():
        value = getattr(config, name)
        if value is None and name == "max_episode_steps":
            continue
        is_list = name.endswith("_sizes") or name == "hidden_sizes"
        if is_list and not isinstance(value, tuple):
            raise ValueError(f"{name} is {value!r}: it must be a tuple of sizes")
        if any(number not in allowed for number in (value if is_list else (value,))):
            raise ValueError(f"{name} is {value}: it must be {allowed}")


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


def _validate_schedule(name: str, points: Schedule) -> None:
    if callable(points):
        return
    if not all(isinstance(point, tuple) and len(point) == 2 for point in points):
        raise ValueError(f"{name} is {points}: it must be (steps, factor) points")
    steps = [point[0] for point in points]
    factors = [point[1] for point in points]
    if steps != sorted(set(steps)) or any(
        not (math.isfinite(number) and number >= 0) for number in steps + factors
    ):
        raise ValueError(
            f"{name} is {points}: it must be (steps, factor) points, all 0 or "
            "more, steps increasing"
        )
