"""Generative Adversarial Self-Imitation Learning in JAX (Guo, Oh, Singh, Lee 2018).

The public names are listed in ``__init__.pyi``. A module is imported when a name of it
is first used, so that `gasil_jax.numpy_policy` needs no JAX.
"""

import os

import lazy_loader

from gasil_jax import compatibility as compatibility
from gasil_jax.host import interruption

if interruption.runs_as_program(__name__):
    interruption.quit_during_imports()
    # XLA reads it on import. Before jaxlib 0.12 it reports an error for each program
    # that it loads from the cache.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
del interruption, os
__version__ = "0.1.0"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
