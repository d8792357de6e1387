"""The interface of all environments here: Brax's `Env`, `State` and `Wrapper`."""

import contextlib
import io

# MJX prints at its first import that its optional Warp backend is absent.
with contextlib.redirect_stdout(io.StringIO()):
    from brax.envs import Env, PipelineEnv, State, Wrapper

__all__ = ["Env", "PipelineEnv", "State", "Wrapper"]
