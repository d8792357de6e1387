"""What a run is: `Config` (static, decides shapes) and `Hyperparameters` (traced).

Defaults are the paper's appendix where it gives a value, else OpenAI baselines', on
which the paper's code was built.
"""

import dataclasses
import difflib
import math
import numbers
from collections.abc import Callable, Mapping
from typing import Any

from flax import struct

#: The factor that a hyperparameter is multiplied by, over environment steps: an
#: Optax schedule (any pure function of the steps), or (steps, factor) points, linear
#: between them and constant beyond; no points are 1 throughout.
Schedule = tuple[tuple[float, float], ...] | Callable[[Any], Any]


class Hyperparameters(struct.PyTreeNode):
    """Every float of the algorithms: a pytree, so a sweep is a `vmap` over leaves.

    Attributes:
      learning_rate: Adam's step size for policy and value.
      learning_rate_decay: the share of the learning rate that is gone, linearly,
        at the end of training: 1 anneals to 0, 0 keeps it constant.
      gamma: discount factor.
      gae_lambda: the lambda of generalized advantage estimation.
      clip_epsilon: PPO's clip range of the probability ratio.
      entropy_coefficient: the paper's lambda, weight of the policy's entropy.
      value_coefficient: weight of the squared error of the value. The value has a
        network, gradient clip and Adam of its own, so it hardly matters.
      max_grad_norm: gradients are scaled down to this global norm, the policy's
        and the value's each for itself.
      alpha: scale of the discriminator's reward (paper, section 4.3).
      discriminator_learning_rate: Adam's step size for the discriminator.
      discriminator_entropy_coefficient: weight of the entropy of D's output.
      behavior_cloning_coefficient: weight of the cloning loss of PPO+BC.
      sil_coefficient: weight of the loss of PPO+SIL.
      sil_value_coefficient: weight of the value's part in it.
      max_buffer_steps: of `Config.buffer_steps` so many are filled at most; None is
        all of them. Traced, so that one program sweeps what else decides shapes.
      max_discriminator_updates: the same of `Config.discriminator_updates`; the
        others are computed too, and not used.
    """

    learning_rate: float = 3e-4
    learning_rate_decay: float = 1.0
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip_epsilon: float = 0.2
    entropy_coefficient: float = 0.0
    value_coefficient: float = 1.0
    max_grad_norm: float = 0.5
    alpha: float = 0.1
    discriminator_learning_rate: float = 1e-4
    discriminator_entropy_coefficient: float = 1e-3
    behavior_cloning_coefficient: float = 0.1
    sil_coefficient: float = 0.1
    sil_value_coefficient: float = 0.01
    max_buffer_steps: float | None = None
    max_discriminator_updates: float | None = None


@dataclasses.dataclass(frozen=True)
class Config:
    """Everything that changes shapes, loop counts or the program; hashable.

    Attributes:
      agent: name of the agent, see `gasil_jax.agents()`.
      total_steps: environment steps a seed; rounded up to whole batches.
      num_envs: environments a seed steps at once.
      batch_steps: environment steps in an iteration, over all environments
        (the paper's horizon).
      num_epochs: passes of PPO over a batch.
      minibatch_size: steps in one gradient step of PPO.
      hidden_sizes: widths of the tanh layers of the policy and of the value.
      buffer_steps: capacity of the good-trajectory buffer, in steps.
      discriminator_updates: gradient steps of the discriminator an iteration.
      discriminator_minibatch_size: policy steps, and as many good steps, in each.
      discriminator_hidden_sizes: widths of the discriminator's tanh layers.
      behavior_cloning_updates: gradient steps of PPO+BC's own an iteration.
      behavior_cloning_minibatch_size: good steps in each.
      sil_updates: gradient steps of PPO+SIL's own an iteration.
      sil_minibatch_size: replayed steps in each.
      sil_buffer_steps: capacity of PPO+SIL's replay, in steps.
      learning_rate_schedule: a factor over env steps that the learning rate is
        multiplied by: STEPS FACTOR pairs, linear between them (from Python also any
        Optax schedule).
      clip_epsilon_schedule: the same for PPO's clip range.
      alpha_schedule: the same for alpha. The paper's rule for Humanoid, 0 for 2M
        steps and then up to alpha until 3M, is ((2e6, 0), (3e6, 1)).
      normalize_rewards: whether PPO's rewards are divided by the standard deviation of
        their running discounted sum (OpenAI baselines' ppo2). Alpha is in that unit
        then, not in the environment's. Agents gasil and gail have no such reward.
      stagger_episodes: whether each environment's first episode begins at an age drawn
        from the whole episode, so that a batch holds steps of all its parts. Without
        it environments that never end early stay in lock-step for the whole run.
      expert: what GAIL imitates: an .npz file with arrays "observation" and
        "action", or "minari:" and the name of a data set.
      max_episode_steps: an episode is truncated after so many steps; None takes
        the environment's own limit, or 1000 if it has none.
      hyperparameters: the floats; `make_train` can replace them under a trace.
    """

    agent: str = "ppo+gasil"
    total_steps: int = 1_000_000
    num_envs: int = 16
    batch_steps: int = 2048
    num_epochs: int = 10
    minibatch_size: int = 64
    hidden_sizes: tuple[int, ...] = (64, 64)
    buffer_steps: int = 1000
    discriminator_updates: int = 5
    discriminator_minibatch_size: int = 128
    discriminator_hidden_sizes: tuple[int, ...] = (100, 100)
    behavior_cloning_updates: int = 10
    behavior_cloning_minibatch_size: int = 64
    sil_updates: int = 10
    sil_minibatch_size: int = 512
    sil_buffer_steps: int = 50_000
    learning_rate_schedule: Schedule = ()
    clip_epsilon_schedule: Schedule = ()
    alpha_schedule: Schedule = ()
    normalize_rewards: bool = False
    stagger_episodes: bool = True
    expert: str | None = None
    max_episode_steps: int | None = None
    hyperparameters: Hyperparameters = dataclasses.field(
        default_factory=Hyperparameters
    )

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
        """A copy with some fields changed."""
        return dataclasses.replace(self, **changes)

    def updated(self, values: Mapping[str, Any]) -> "Config":
        """A copy with some values changed, of its own fields or of hyperparameters."""
        own = {field.name for field in dataclasses.fields(self)}
        floats = {name: x for name, x in values.items() if name not in own}
        changes = {name: x for name, x in values.items() if name in own}
        hyperparameters = self.hyperparameters.replace(**floats)
        return self.replace(hyperparameters=hyperparameters, **changes)


def nearest(name: str, allowed: tuple[str, ...]) -> str:
    """The allowed name that is most like `name`."""
    return difflib.get_close_matches(name, allowed, n=1, cutoff=0.0)[0]


def unknown(kind: str, name: str, allowed: tuple[str, ...]) -> str:
    """What to say of a name that is none of the allowed ones."""
    return (
        f"{kind} {name!r} is unknown: did you mean {nearest(name, allowed)!r}? "
        f"(one of {', '.join(allowed)})"
    )


# name -> (lowest, highest, whether the lowest itself is allowed)
_HYPERPARAMETER_RANGES = {
    "learning_rate": (0.0, math.inf, False),
    "learning_rate_decay": (0.0, 1.0, True),
    "gamma": (0.0, 1.0, True),
    "gae_lambda": (0.0, 1.0, True),
    "clip_epsilon": (0.0, math.inf, False),
    "entropy_coefficient": (0.0, math.inf, True),
    "value_coefficient": (0.0, math.inf, True),
    "max_grad_norm": (0.0, math.inf, False),
    "alpha": (0.0, math.inf, True),
    "discriminator_learning_rate": (0.0, math.inf, False),
    "discriminator_entropy_coefficient": (0.0, math.inf, True),
    "behavior_cloning_coefficient": (0.0, math.inf, True),
    "sil_coefficient": (0.0, math.inf, True),
    "sil_value_coefficient": (0.0, math.inf, True),
    "max_buffer_steps": (1.0, math.inf, True),
    "max_discriminator_updates": (1.0, math.inf, True),
}


_SCHEDULES = ("learning_rate_schedule", "clip_epsilon_schedule", "alpha_schedule")
_SIZES = ("hidden_sizes", "discriminator_hidden_sizes")
_SWITCHES = ("normalize_rewards", "stagger_episodes")
_NOT_A_COUNT = (
    *("agent", *_SWITCHES, "expert", "hyperparameters"),
    *_SCHEDULES,
)


def validate(config: Config, agents: tuple[str, ...]) -> None:
    """Raise `ValueError`, naming the value and what is allowed, for a bad config.

    Args:
      config: what to check. Hyperparameters that are JAX arrays are not looked at:
        they may be traced.
      agents: the registered agents' names.
    """
    if config.agent not in agents:
        raise ValueError(unknown("agent", config.agent, agents))
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if field.name in _NOT_A_COUNT:
            continue
        if value is None and field.name == "max_episode_steps":
            continue
        sizes = field.name in _SIZES
        if sizes and not isinstance(value, tuple):
            raise ValueError(f"{field.name} is {value!r}: it must be a tuple of sizes")
        for number in value if sizes else (value,):
            # A bool is one too, and NumPy's are not int.
            is_whole = isinstance(number, numbers.Integral) and number is not True
            if not is_whole or int(number) < 1:
                raise ValueError(
                    f"{field.name} is {value}: it must be a whole number, 1 or more"
                )
    for name in _SWITCHES:
        if not isinstance(value := getattr(config, name), bool):
            raise ValueError(f"{name} is {value!r}: it must be True or False")
    for whole, part in (("batch_steps", "num_envs"), ("batch_steps", "minibatch_size")):
        total, size = getattr(config, whole), getattr(config, part)
        if total % size:
            small = [n for n in range(1, math.isqrt(total) + 1) if total % n == 0]
            divisors = small + [total // n for n in reversed(small)]
            closest = min(divisors, key=lambda n: abs(n - size))
            raise ValueError(
                f"{part} is {size}, which does not divide {whole} {total}: "
                f"the nearest that does is {closest}"
            )
    for name in _SCHEDULES:
        points = getattr(config, name)
        if callable(points):
            continue
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
    for name, (low, high, closed) in _HYPERPARAMETER_RANGES.items():
        value = getattr(config.hyperparameters, name)
        if isinstance(value, str):
            raise ValueError(f"{name} is {value!r}: it must be a number")
        if not isinstance(value, numbers.Real):
            continue
        number = float(value)
        above = number >= low if closed else number > low
        if not (above and number <= high and math.isfinite(number)):
            least = f"{low:g} or more" if closed else f"more than {low:g}"
            most = "finite" if math.isinf(high) else f"at most {high:g}"
            raise ValueError(f"{name} is {value}: it must be {least} and {most}")
