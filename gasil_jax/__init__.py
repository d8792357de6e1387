"""Generative Adversarial Self-Imitation Learning in JAX (Guo, Oh, Singh, Lee 2018)."""

import importlib
from typing import TYPE_CHECKING, Any

from gasil_jax import compatibility as compatibility

if TYPE_CHECKING:
    from gasil_jax.config import Config as Config
    from gasil_jax.config import Hyperparameters as Hyperparameters
    from gasil_jax.host.environments import make_env as make_env
    from gasil_jax.host.fitting import FitProgress as FitProgress
    from gasil_jax.host.fitting import FitResult as FitResult
    from gasil_jax.host.fitting import fit as fit
    from gasil_jax.host.members import member as member
    from gasil_jax.imitation import agents as agents
    from gasil_jax.policy import load_policy as load_policy
    from gasil_jax.presets import preset as preset
    from gasil_jax.train import TrainState as TrainState
    from gasil_jax.train import init as init
    from gasil_jax.train import iterate as iterate
    from gasil_jax.train import make_train as make_train

__version__ = "0.1.0"

#: The module that defines each public name.
_MODULES = {
    "Config": "config",
    "FitProgress": "host.fitting",
    "FitResult": "host.fitting",
    "Hyperparameters": "config",
    "TrainState": "train",
    "agents": "imitation",
    "fit": "host.fitting",
    "init": "train",
    "iterate": "train",
    "load_policy": "policy",
    "make_env": "host.environments",
    "make_train": "train",
    "member": "host.members",
    "preset": "presets",
}

__all__ = [*_MODULES]


def __getattr__(name: str) -> Any:
    # Modules are imported on first use, so that `gasil_jax.numpy_policy` needs no JAX.
    if name not in _MODULES:
        raise AttributeError(f"module 'gasil_jax' has no attribute {name!r}")
    return getattr(importlib.import_module(f"gasil_jax.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
