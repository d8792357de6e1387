"""Ways of imitating the good-trajectory buffer, one file each, and their registry.

An agent is PPO plus one `Imitation`. To add one, write a file with such a tuple and
name it in `AGENTS`.
"""

from gasil_jax.imitation import adversarial, none
from gasil_jax.imitation.interface import Imitation

AGENTS: dict[str, Imitation] = {
    "ppo": none.PPO,
    "gasil": adversarial.GASIL,
    "ppo+gasil": adversarial.PPO_GASIL,
}

__all__ = ["AGENTS", "Imitation"]
