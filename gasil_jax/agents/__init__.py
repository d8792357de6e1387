"""The agents: PPO, and the ways of imitating that are added to it, one file each.

To add one to the package, write a file that defines an `Agent` and add it to `AGENTS`.
An agent of your own code is named MODULE:CLASS and needs no entry.
"""

from collections.abc import Mapping

from gasil_jax.agents.adaptive import PPOGASILAdaptive
from gasil_jax.agents.adversarial import GAIL, GASIL, PPOGASIL
from gasil_jax.agents.behavior_cloning import PPOBC
from gasil_jax.agents.gasil_novelty import PPOGASILNovelty
from gasil_jax.agents.interface import Agent
from gasil_jax.agents.novelty import PPOBCNovelty, PPONovelty
from gasil_jax.agents.ppo import PPO
from gasil_jax.agents.self_imitation import PPOSIL
from gasil_jax.config import names

#: The package's own agents by name.
AGENTS: Mapping[str, type[Agent]] = {
    agent.name: agent
    for agent in (
        PPO,
        PPOBC,
        PPONovelty,
        PPOBCNovelty,
        PPOSIL,
        GASIL,
        PPOGASIL,
        PPOGASILAdaptive,
        PPOGASILNovelty,
        GAIL,
    )
}


def agents_with(setting: str) -> list[str]:
    """Return the names of the package's agents that have a setting."""
    return [name for name, agent in AGENTS.items() if setting in names(agent)]


__all__ = [
    "AGENTS",
    "GAIL",
    "GASIL",
    "PPO",
    "PPOBC",
    "PPOGASIL",
    "PPOSIL",
    "Agent",
    "PPOBCNovelty",
    "PPOGASILAdaptive",
    "PPOGASILNovelty",
    "PPONovelty",
    "agents_with",
]
