"""Pure-JAX environments with Brax's ``Env``/``State`` interface.

``make("walker2d", reward_delay=20)`` returns an environment whose ``reset`` and
``step`` are pure functions for ``jax.jit`` and ``jax.vmap``; ``names()`` lists all
environments. ``Locomotion(Task(...))`` is a robot of your own. Nothing here imports
``gasil_jax``.
"""

import contextlib
import io

# MJX prints at its first import that its optional Warp backend is absent.
with contextlib.redirect_stdout(io.StringIO()):
    import mujoco.mjx  # noqa: F401

from gasil_envs.locomotion import Locomotion, Task
from gasil_envs.registry import make, names

__all__ = ["Locomotion", "Task", "make", "names"]
