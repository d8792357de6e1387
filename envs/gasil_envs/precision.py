"""Multiply matrices in full float32 on devices that use less by default."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar, cast

import jax

Function = TypeVar("Function", bound=Callable[..., Any])


def full_precision(function: Function) -> Function:
    """Make a function's traced matrix products use full float32.

    GPUs from Ampere on use TF32 by default, whose fraction has ten bits; PPO runs have
    failed with it. If a program sets `jax_default_matmul_precision` itself, that
    setting applies instead.
    """

    @functools.wraps(function)
    def traced(*args: Any, **kwargs: Any) -> Any:
        config: Any = jax.config  # Its type does not declare the options.
        if config.jax_default_matmul_precision is not None:
            return function(*args, **kwargs)
        with jax.default_matmul_precision("highest"):
            return function(*args, **kwargs)

    return cast(Function, traced)
