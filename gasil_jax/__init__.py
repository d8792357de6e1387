"""Generative Adversarial Self-Imitation Learning in JAX (Guo, Oh, Singh, Lee 2018).

The public names are listed in ``__init__.pyi``. A module is imported when a name of it
is first used, so that `gasil_jax.numpy_policy` needs no JAX.
"""

import contextlib
import importlib.metadata
import sys

import lazy_loader

if sys.platform == "win32":
    raise ImportError("gasil_jax runs on Linux and macOS: on Windows, use WSL")
with contextlib.suppress(importlib.metadata.PackageNotFoundError):
    if importlib.metadata.version("jaxlib") == "0.10.2":
        raise ImportError(
            "jaxlib 0.10.2 gives wrong numbers on a CPU (jax issue 39103): install "
            "another one, 0.10.1 or 0.12 and later"
        )
del contextlib, importlib, sys
__version__ = "0.1.0"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
