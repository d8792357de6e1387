"""Pure-JAX environments with Brax's ``Env``/``State`` interface.

``make("walker2d", reward_delay=20)`` returns an environment whose ``reset`` and
``step`` are pure functions for ``jax.jit`` and ``jax.vmap``; ``names()`` lists
what there is. Nothing here imports ``gasil_jax``.
"""

from gasil_envs.registry import make, names

__all__ = ["make", "names"]
