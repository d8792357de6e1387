"""Generative Adversarial Self-Imitation Learning in JAX (Guo, Oh, Singh, Lee 2018)."""

import importlib
from typing import TYPE_CHECKING, Any

from gasil_jax import compatibility as compatibility

if TYPE_CHECKING:
    from gasil_jax.batch import member
    from gasil_jax.config import Config, Hyperparameters
    from gasil_jax.environments import make_env
    from gasil_jax.imitation import agents
    from gasil_jax.policy import load_policy
    from gasil_jax.presets import preset
    from gasil_jax.train import TrainState, init, iterate, make_train

_HOMES = {
    "Config": "config",
    "Hyperparameters": "config",
    "TrainState": "train",
    "agents": "imitation",
    "init": "train",
    "iterate": "train",
    "load_policy": "policy",
    "make_env": "environments",
    "make_train": "train",
    "member": "batch",
    "preset": "presets",
}

__all__ = [
    "Config",
    "Hyperparameters",
    "TrainState",
    "agents",
    "init",
    "iterate",
    "load_policy",
    "make_env",
    "make_train",
    "member",
    "preset",
]


def __getattr__(name: str) -> Any:
    # Not before it is asked for: `gasil_jax.numpy_policy` runs where JAX is not.
    if name not in _HOMES:
        raise AttributeError(f"module 'gasil_jax' has no attribute {name!r}")
    return getattr(importlib.import_module(f"gasil_jax.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
