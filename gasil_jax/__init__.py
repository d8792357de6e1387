"""Generative Adversarial Self-Imitation Learning in JAX (Guo, Oh, Singh, Lee 2018)."""

from gasil_jax import compatibility as compatibility
from gasil_jax.batch import member
from gasil_jax.config import Config, Hyperparameters
from gasil_jax.environments import make_env
from gasil_jax.imitation import AGENTS
from gasil_jax.presets import preset
from gasil_jax.train import TrainState, init, iterate, make_train


def agents() -> tuple[str, ...]:
    """The names that `Config.agent` takes."""
    return tuple(AGENTS)


__all__ = [
    "Config",
    "Hyperparameters",
    "TrainState",
    "agents",
    "init",
    "iterate",
    "make_env",
    "make_train",
    "member",
    "preset",
]
