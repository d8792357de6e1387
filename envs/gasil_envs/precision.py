"""Matrix products in float32 on devices whose default is less."""

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import jax

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def full_precision(
    function: Callable[Arguments, Result],
) -> Callable[Arguments, Result]:
    """Have what a function traces multiply matrices in full float32.

    Without a word a GPU from Ampere on takes TF32, with ten bits for the fraction,
    which has ruined PPO runs. A program that sets `jax_default_matmul_precision`
    itself gets what it asks for.
    """

    @functools.wraps(function)
    def traced(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        config: Any = jax.config  # Its options are attributes that its type lacks.
        if config.jax_default_matmul_precision is not None:
            return function(*args, **kwargs)
        with jax.default_matmul_precision("highest"):
            return function(*args, **kwargs)

    return traced
