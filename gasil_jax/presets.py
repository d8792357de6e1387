"""Presets: settings that runs start from, by environment, agent and reward delay.

A preset has rows, each for an environment and an agent. A row overrides the defaults of
the settings; a flag overrides a row. docs/running.md says what each preset is for, and
from which search its rows are.
"""

import json
import pathlib
import types
from collections.abc import Mapping
from typing import Any, NamedTuple

from gasil_envs import worlds
from gasil_jax.agents import AGENTS, Agent
from gasil_jax.algorithms import Algorithm
from gasil_jax.config import Range
from gasil_jax.errors import refusal, unknown

#: The preset that runs start from if none is named.
DEFAULT = "tuned"
_COUNT = Range(1, 2**31 - 1, whole=True)
Overrides = Mapping[str, Any]
#: (environment, agent) -> overrides.
Rows = Mapping[tuple[str, str], Overrides]

#: The settings that searches chose: by "dense", "delayed", "paper dense" or "paper
#: delayed"; then by environment; then by agent. `python -m experiments report` writes
#: the rows of complete searches, and leaves the others as they are.
TUNED = pathlib.Path(__file__).with_name("tuned_presets.json")

_CHOSEN: Mapping[str, Any] = json.loads(TUNED.read_text())
#: The tasks of MuJoCo, each with the dimension of its actions.
ACTION_SIZES = {
    "hopper": 3,
    "walker2d": 6,
    "halfcheetah": 6,
    "swimmer": 2,
    "ant": 8,
    "humanoid": 17,
    "humanoidstandup": 17,
    "inverted_pendulum": 1,
    "inverted_double_pendulum": 1,
    "reacher": 2,
    "pusher": 7,
}
#: The agents that follow the rule "scaled", in any environment; by default the last,
#: which also has an entropy bonus.
RULED = ("ppo", "ppo+novelty", "ppo+gasil+novelty")
#: The dimension that discrete actions count as, in that rule.
DISCRETE_SIZE = 2
# One setting of adaptive imitation for every task, chosen on two seeds a task with
# rewards delayed by 20 steps (experiments/notes/adaptive_ablation.md).
_ADAPTIVE = {
    "normalize_rewards": True,
    "num_envs": 32,
    "gamma": 0.995,
    "initial_std": 0.4,
    "imitation_weight": 0.7,
    "discriminator_updates": 20,
    "discriminator_learning_rate": 1e-4,
    "buffer_steps": 10_000,
}
#: The same for delayed rewards.
ADAPTIVE_DELAYED = {**_ADAPTIVE, "decompose_rewards": True}

_GYMNAX = {
    "num_envs": 32,
    "batch_steps": 2048,
    "num_epochs": 4,
    "minibatch_size": 256,
    "learning_rate": 1e-3,
    "entropy_coefficient": 0.01,
    "normalize_rewards": True,
}


def _searched(rewards: str, adaptive: Overrides | None = None) -> Rows:
    """Return the rows that searches chose, and adaptive imitation's elsewhere."""
    tasks = ACTION_SIZES if adaptive is not None else ()
    rows: dict[tuple[str, str], Any] = {
        (env, "ppo+gasil-adaptive"): adaptive for env in tasks
    }
    for env, agents in _CHOSEN.get(rewards, {}).items():
        rows |= {(env, agent): row for agent, row in agents.items()}
    return rows


def scaled(action_size: int, decompose_rewards: bool) -> Overrides:
    """Return settings that depend on the dimension of an action.

    They fall linearly from two dimensions to eight, and are the same for more
    (docs/results/ablations.md): with more dimensions the searches chose a smaller
    learning rate and less exploration, and noise makes returns vary more.
    """
    return {
        "normalize_rewards": True,
        "decompose_rewards": decompose_rewards,
        "num_envs": 32,
        "gamma": 0.995,
        "learning_rate": _between(7.5e-4, 1e-4, action_size),
        "initial_std": _between(0.7, 0.25, action_size),
        "gae_lambda": _between(0.975, 0.9, action_size),
    }


def scaled_with_entropy(action_size: int, decompose_rewards: bool) -> Overrides:
    """Return the same with an entropy bonus, the rule of PPO+GASIL+NOVELTY.

    It too falls linearly: from eight dimensions on there is none.
    """
    entropy = _between(0.01, 0.0, action_size)
    row = scaled(action_size, decompose_rewards)
    return {**row, "entropy_coefficient": entropy}


def _between(two: float, eight: float, action_size: int) -> float:
    """Return a value on the line from two dimensions to eight, and beyond its end."""
    share = min(max((action_size - 2) / 6, 0.0), 1.0)
    return two * (1 - share) + eight * share


def is_ruled(agent: str, name: str) -> bool:
    """Return whether a preset has the rule "scaled" for an agent."""
    return agent in RULED if name == "scaled" else (name, agent) == (DEFAULT, RULED[-1])


class Preset(NamedTuple):
    """The overrides of a preset, by environment and agent."""

    dense: Rows  # for rewards that are given at every step
    delayed: Rows  # for delayed rewards
    every: Overrides = types.MappingProxyType({})  # for all; a row takes precedence


PRESETS: Mapping[str, Preset] = {
    "tuned": Preset(
        _searched("dense", _ADAPTIVE), _searched("delayed", ADAPTIVE_DELAYED)
    ),
    "scaled": Preset({}, {}),  # a rule, see `scaled`
    "gymnax": Preset({}, {}, every=_GYMNAX),
    "paper": Preset(
        {
            # Until its search is complete: alpha is 0 for 2M steps and then raised to
            # 0.02 until 3M.
            ("humanoid", "ppo+gasil"): {
                "alpha": 0.02,
                "alpha_schedule": ((2e6, 0.0), (3e6, 1.0)),
            },
            **_searched("paper dense"),
        },
        _searched("paper delayed"),
        # The paper's horizon is 2,048 steps of one environment. Staggering would only
        # matter with several.
        every={"num_envs": 1, "stagger_episodes": False, "normalize_rewards": True},
    ),
}


def names() -> tuple[str, ...]:
    """Return the names of the presets."""
    return tuple(PRESETS)


def check(name: str) -> None:
    """Raise `ValueError` unless there is a preset of this name."""
    if not isinstance(name, str) or name not in PRESETS:
        raise ValueError(unknown("preset", name, names()))


def preset(
    env: str,
    agent: str | type[Agent] = "ppo+gasil",
    name: str = DEFAULT,
    *,
    reward_delay: int = 1,
    action_size: int | None = None,
) -> Algorithm:
    """Return the algorithm that runs of `agent` in `env` start from.

    Args:
      env: name of the environment.
      agent: name of the agent, or its class.
      name: name of the preset, one of `names()`.
      reward_delay: the environment's reward delay, in steps.
      action_size: dimension of an action, `DISCRETE_SIZE` if actions are discrete. The
        rule "scaled" needs it for an environment that is no locomotion task of ours.

    Returns:
      The defaults, overridden by what the preset has for all tasks and by its row. If
      "tuned" has no row for the agent on the task, the result is the defaults.

    Raises:
      ValueError: if the environment, the agent or the preset is unknown, if the delay
        is no whole number from 1 on, or if a preset other than "tuned" has nothing for
        the agent on the task.
    """
    check(name)
    kind = AGENTS.get(agent, agent) if isinstance(agent, str) else agent
    if not (isinstance(kind, type) and issubclass(kind, Agent)):
        raise ValueError(unknown("agent", agent, tuple(AGENTS)))
    if reward_delay not in _COUNT:
        raise refusal("reward_delay", reward_delay, _COUNT)
    if action_size is not None and action_size not in _COUNT:
        raise refusal("action_size", action_size, _COUNT)
    ours, others = ("point_mass", *ACTION_SIZES), (*worlds.forms(), "MODULE:NAME")
    if not isinstance(env, str) or (env not in ours and ":" not in env):
        raise ValueError(unknown("env", env, ours, forms=others))
    if is_ruled(kind.name, name):
        size = ACTION_SIZES.get(env) if action_size is None else action_size
        if size is None:
            raise ValueError(
                f"action_size is None: preset {name!r} needs the dimension of {env}'s "
                "actions, which is env.action_size, or 2 if they are discrete"
            )
        rule = scaled_with_entropy if kind.name == RULED[-1] else scaled
        row = rule(size, reward_delay > 1)
        return Algorithm(kind()).replace(**row)
    lacking = describe_lack(env, kind.name, name, reward_delay=reward_delay)
    if lacking is not None and name != DEFAULT:
        raise ValueError(f"{lacking}: it is for {', '.join(RULED)}")
    row = _rows(name, reward_delay).get((env, kind.name), {})
    return Algorithm(kind()).replace(**{**PRESETS[name].every, **row})


def describe_lack(env: str, agent: str, name: str, *, reward_delay: int) -> str | None:
    """Return in words that a preset has nothing for an agent on a task, or None."""
    rows = _rows(name, reward_delay)
    if PRESETS[name].every or is_ruled(agent, name) or (env, agent) in rows:
        return None
    rewards = "delayed" if reward_delay > 1 else "dense"
    what = f"agent {agent!r} on {env} with {rewards} rewards"
    return f"preset {name!r} has nothing for {what}"


def _rows(name: str, reward_delay: int) -> Rows:
    return PRESETS[name].delayed if reward_delay > 1 else PRESETS[name].dense
