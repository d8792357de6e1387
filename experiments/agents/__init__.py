"""Agents that only experiments need, written as a user of the package writes them."""

from collections.abc import Mapping
from typing import Any

import gasil_jax
from experiments.agents.constant_bonus import PPOBonus
from gasil_jax.algorithms import Algorithm

#: The experiments' own agents, by the names that figures and stored runs have for them.
OWN: Mapping[str, type[gasil_jax.Agent]] = {"ppo+bonus": PPOBonus}
AGENTS: Mapping[str, type[gasil_jax.Agent]] = {**gasil_jax.agents.AGENTS, **OWN}


def algorithm(agent: str, **settings: Any) -> Algorithm:
    """Return the algorithm of an agent's name, with settings by name."""
    return Algorithm(AGENTS[agent]()).replace(**settings)
