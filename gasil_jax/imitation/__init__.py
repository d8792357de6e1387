"""Ways of imitating the good-trajectory buffer, one file each, and their registry.

An agent is PPO plus one `Imitation`. To add one, write a file with such a tuple and
name it in `AGENTS`.
"""

from gasil_jax.imitation import adversarial, behavior_cloning, none, self_imitation
from gasil_jax.imitation.interface import Imitation

AGENTS: dict[str, Imitation] = {
    "ppo": none.PPO,
    "ppo+bc": behavior_cloning.PPO_BC,
    "ppo+sil": self_imitation.PPO_SIL,
    "gasil": adversarial.GASIL,
    "ppo+gasil": adversarial.PPO_GASIL,
    "gail": adversarial.GAIL,
}


def agents() -> tuple[str, ...]:
    """The names that `Config.agent` takes."""
    return tuple(AGENTS)


def unused(agent: str) -> frozenset[str]:
    """Names of what other agents look at and this one does not, if it says so."""
    mine = AGENTS[agent].fields
    if mine is None:
        return frozenset()
    every = {name for each in AGENTS.values() for name in each.fields or ()}
    return frozenset(every.difference(mine))


__all__ = ["AGENTS", "Imitation", "agents", "unused"]
