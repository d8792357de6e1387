"""Generative Adversarial Self-Imitation Learning in JAX (Guo, Oh, Singh, Lee 2018).

The public names are listed in ``__init__.pyi``. A module is imported when a name of it
is first used, so that `gasil_jax.numpy_policy` needs no JAX.
"""

import lazy_loader

from gasil_jax import compatibility as compatibility
from gasil_jax.host import interruption

interruption.quit_during_imports(__name__)
del interruption
__version__ = "0.1.0"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
