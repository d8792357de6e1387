"""Pure-JAX environments with Brax's ``Env``/``State`` interface.

``make("walker2d", reward_delay=20)`` returns an environment whose ``reset`` and
``step`` are pure functions for ``jax.jit`` and ``jax.vmap``; ``names()`` lists all
environments. ``Locomotion(Task(...))`` is a robot of your own. Nothing here imports
``gasil_jax``. A module is imported when a name of it is first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
