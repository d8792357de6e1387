"""All that decides how a run learns: an agent, reward models, and the config of PPO."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from gasil_jax.agents import AGENTS, Agent, agents_with
from gasil_jax.config import (
    SCHEDULE_SUFFIX,
    Config,
    Schedule,
    names,
    traced_names,
    validate,
    validate_config,
    validate_switch,
)
from gasil_jax.errors import refusal, unknown
from gasil_jax.rewards import REWARD_MODELS, RewardModel


@dataclasses.dataclass(frozen=True)
class Algorithm:
    """An agent, the models of the rewards that it learns from, and the config of PPO.

    All settings of these parts have different names, so `replace` takes them by name:
    ``algorithm.replace(alpha=0.2, num_envs=8)``. A model of rewards is added or left
    out by its switch, as in ``replace(decompose_rewards=True)``.

    Attributes:
      agent: the agent.
      rewards: models of rewards, the first one nearest to the environment.
      config: the settings of the training loop and of PPO.
    """

    agent: Agent
    rewards: tuple[RewardModel, ...] = ()
    config: Config = dataclasses.field(default_factory=Config)

    @property
    def parts(self) -> tuple[Any, ...]:
        """Every part that has settings."""
        return (self.config, self.agent, *self.rewards)

    @property
    def settings(self) -> dict[str, Any]:
        """Every setting by name, and the switches of the models of rewards."""
        have = {type(model) for model in self.rewards}
        return {
            **{name: getattr(x, name) for x in self.parts for name in names(x)},
            **{model.switch: model in have for model in REWARD_MODELS},
        }

    @property
    def own_models(self) -> tuple[RewardModel, ...]:
        """The models of rewards that are not the package's."""
        return tuple(x for x in self.rewards if type(x) not in REWARD_MODELS)

    @property
    def hyperparameters(self) -> dict[str, Any]:
        """The numbers that may be traced, by name, with their values here."""
        return {
            name: getattr(part, name)
            for part in self.parts
            for name in traced_names(part)
        }

    def replace(self, **changes: Any) -> "Algorithm":
        """Return a copy with changed settings, which are named as in `settings`.

        Raises:
          ValueError: if a name is no setting of any part.
        """
        changed = self
        for model in REWARD_MODELS:
            if model.switch in changes:
                changed = changed._with(model, changes.pop(model.switch))
        parts = []
        for part in changed.parts:
            own = {x: changes.pop(x) for x in names(part) if x in changes}
            parts.append(part.replace(**own) if own else part)
        for name in changes:
            raise ValueError(changed.why_not(name))
        config, agent, *models = parts
        return Algorithm(agent, tuple(models), config)

    def _with(self, model: type[RewardModel], is_on: Any) -> "Algorithm":
        """Return a copy with or without a model, in the order of `REWARD_MODELS`."""
        validate_switch(model.switch, is_on)
        others = [x for x in self.rewards if not isinstance(x, model)]
        if (len(others) < len(self.rewards)) == is_on:
            return self
        if is_on:
            later = REWARD_MODELS[REWARD_MODELS.index(model) :]
            places = [i for i, x in enumerate(others) if isinstance(x, later)]
            others.insert(min(places, default=len(others)), model())
        return dataclasses.replace(self, rewards=tuple(others))

    def why_not(self, name: str) -> str:
        """Return why a name is no setting of this algorithm, as an error message."""
        for model in REWARD_MODELS:
            if name in names(model):
                return f"{name} has no effect: {model.switch} is off"
        if agents := agents_with(name):
            return (
                f"{name} is a setting of {', '.join(agents)}, not of {self.agent.name}"
            )
        return unknown("setting", name, tuple(self.settings))

    def at(
        self, hyperparameters: Mapping[str, jax.Array], iteration: jax.Array
    ) -> "Algorithm":
        """Return the algorithm with its numbers in an iteration, by their schedules.

        Args:
          hyperparameters: the run's own numbers by name, () each, before schedules.
          iteration: int32 (), number of iterations before this one.
        """
        config, numbers = self.config, dict(hyperparameters)
        # In float32, because int32 would overflow at 2^31 steps.
        env_steps = iteration.astype(jnp.float32) * config.batch_steps
        # A user's own loop may run for more iterations than the config has.
        decay = numbers["learning_rate_decay"]
        remaining = jnp.maximum(1.0 - decay * (iteration / config.num_iterations), 0)
        numbers["learning_rate"] = numbers["learning_rate"] * remaining
        for name, value in self.settings.items():
            if name.endswith(SCHEDULE_SUFFIX):
                number = name.removesuffix(SCHEDULE_SUFFIX)
                numbers[number] = numbers[number] * schedule_factor(value, env_steps)
        return self.replace(**numbers)


def schedule_factor(schedule: Schedule, env_steps: jax.Array) -> jax.Array:
    """Return a schedule's factor, float32 (), at `env_steps`, float32 ().

    Between points it is linear, and constant beyond them.
    """
    if callable(schedule):
        return jnp.asarray(schedule(env_steps), jnp.float32)
    if not schedule:
        return jnp.float32(1.0)
    steps, factors = (jnp.array(column, jnp.float32) for column in zip(*schedule))
    return jnp.interp(env_steps, steps, factors)


def algorithm(agent: str = "ppo+gasil", **settings: Any) -> Algorithm:
    """Return an algorithm by names: ``algorithm("ppo+bc", num_envs=8)``.

    Args:
      agent: name of one of the package's agents.
      **settings: as in `Algorithm.replace`; the others have their defaults.

    Raises:
      ValueError: if a name is unknown.
    """
    if not isinstance(agent, str) or agent not in AGENTS:
        raise ValueError(unknown("agent", agent, tuple(AGENTS)))
    return Algorithm(AGENTS[agent]()).replace(**settings)


#: Columns of a sweep's tables, whose names no setting may have.
_COLUMNS = frozenset(
    "point seed mean diverged diverged_seeds final_return final_length "
    "final_evaluation agent".split()
)


def check(algorithm: Algorithm) -> None:
    """Raise `ValueError` unless every setting is allowed, alone and with the others."""
    if not isinstance(algorithm, Algorithm):
        raise refusal("algorithm", algorithm, "a gasil_jax.Algorithm")
    agent, rewards, config = algorithm.agent, algorithm.rewards, algorithm.config
    if not isinstance(config, Config):
        raise refusal("config", config, "a gasil_jax.Config")
    if not isinstance(agent, Agent):
        raise refusal("agent", agent, "an instance of a class from gasil_jax.Agent")
    models = rewards if isinstance(rewards, tuple) else (None,)
    if not all(isinstance(model, RewardModel) for model in models):
        raise refusal("rewards", rewards, "a tuple of models of rewards")
    validate_config(config)
    taken = {*_COLUMNS, *names(Config)}
    taken.update(x for model in REWARD_MODELS for x in (model.switch, *names(model)))
    for part in (agent, *algorithm.own_models):
        for name in names(part):
            if name in taken:
                raise ValueError(
                    f"{type(part).__name__} has a setting {name!r}, a name that is "
                    "taken: it must be a new one"
                )
        taken.update(names(part))
    for part in (agent, *rewards):
        validate(part)
    if agent.num_streams > 1 and type(agent).mix is Agent.mix:
        raise ValueError(
            f"agent {agent.name!r} has {agent.num_streams} reward streams: it must "
            "have a function mix that combines their advantages"
        )


def check_numbers(algorithm: Algorithm, hyperparameters: Mapping[str, Any]) -> None:
    """Raise `ValueError` unless an algorithm has these numbers, and allows them."""
    if not isinstance(hyperparameters, Mapping):
        raise refusal("hyperparameters", hyperparameters, "numbers by name")
    for name in hyperparameters:
        if name in algorithm.settings and name not in algorithm.hyperparameters:
            raise ValueError(
                f"{name} is not traced: change it with algorithm.replace instead"
            )
    for part in algorithm.replace(**hyperparameters).parts:
        validate(part)
