"""The imitation methods, one file each, and the registry of agents.

An agent is PPO plus one `Imitation`. To add an agent to the package, write a file that
defines one and add it to `AGENTS`. An agent of your own code is named MODULE:NAME and
needs no entry.
"""

from gasil_jax import registry
from gasil_jax.imitation import (
    adaptive,
    adversarial,
    behavior_cloning,
    constant_bonus,
    none,
    self_imitation,
)
from gasil_jax.imitation.interface import Imitation

AGENTS: dict[str, Imitation] = registry.AGENTS
AGENTS |= {
    "ppo": none.PPO,
    "ppo+bonus": constant_bonus.PPO_BONUS,
    "ppo+bc": behavior_cloning.PPO_BC,
    "ppo+sil": self_imitation.PPO_SIL,
    "gasil": adversarial.GASIL,
    "ppo+gasil": adversarial.PPO_GASIL,
    "ppo+gasil-adaptive": adaptive.PPO_GASIL_ADAPTIVE,
    "gail": adversarial.GAIL,
}


def agents() -> tuple[str, ...]:
    """Return the names of the package's agents, which `Config.agent` may have."""
    return tuple(AGENTS)


def find_agent(name: str) -> Imitation:
    """Return the agent with a name of `AGENTS`, or of the form MODULE:NAME.

    Raises:
      ValueError: if there is no such agent.
    """
    return registry.find(name)


def unused(agent: str) -> frozenset[str]:
    """Return the names of the fields that other agents use and this one does not.

    The set is empty if the agent does not say which fields it uses.
    """
    used = find_agent(agent).fields
    if used is None:
        return frozenset()
    every = {name for each in AGENTS.values() for name in each.fields or ()}
    return frozenset(every.difference(used))


__all__ = ["AGENTS", "Imitation", "agents", "find_agent", "unused"]
