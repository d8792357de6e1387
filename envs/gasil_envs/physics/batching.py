"""Functions whose arrays have the batch as their last axis.

With 5 to 30 degrees of freedom the batch is the only axis of a simulation that is long
enough to fill vector units, so it is the last, the one that is contiguous in memory.
"""

from collections.abc import Callable, Iterable
from typing import Any, cast

import jax
import jax.numpy as jnp
from jax.experimental.xla_metadata import set_xla_metadata


def on_cpu() -> bool:
    """Whether programs are compiled for a CPU."""
    return jax.default_backend() == "cpu"


def on_gpu() -> bool:
    """Whether programs are compiled for a GPU."""
    return jax.default_backend() == "gpu"


_identity = jax.jit(lambda tree: tree)


def materialize(tree: Any) -> Any:
    """Make arrays be computed once and stored, however often they are used.

    XLA's CPU backend fuses a chain of elementwise operations into each of its users and
    computes it again in each. It removes optimization barriers before it does, but
    does not look into a call that is not to be inlined.
    """
    if not on_cpu():
        return jax.lax.optimization_barrier(tree)
    with set_xla_metadata(inlineable="false"):
        return _identity(tree)


def add(terms: Iterable[jax.Array]) -> jax.Array:
    """Sum at least one array, spelled out."""
    # The type of `sum` does not express that there is one.
    return cast(jax.Array, sum(terms))


def batch_last(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Make `jax.vmap`, nested if needed, extend a trailing batch axis.

    Args:
      function: from a tree of arrays to a tree of arrays, all with a trailing batch.

    Returns:
      The same function of arrays without a batch.
    """
    function = jax.custom_batching.custom_vmap(function)

    @function.def_vmap
    def rule(axis_size: int, in_batched: list[Any], tree: Any) -> tuple[Any, Any]:
        is_batched = in_batched[0]

        def join(x: jax.Array, batched: bool) -> jax.Array:
            if not batched:
                x = jnp.broadcast_to(x, (axis_size, *x.shape))
            x = jnp.moveaxis(x, 0, -2)
            return x.reshape(*x.shape[:-2], x.shape[-2] * x.shape[-1])

        def part(x: jax.Array) -> jax.Array:
            x = x.reshape(*x.shape[:-1], axis_size, x.shape[-1] // axis_size)
            return jnp.moveaxis(x, -2, 0)

        joined = materialize(jax.tree.map(join, tree, is_batched))
        result = materialize(function(joined))
        result = jax.tree.map(part, result)
        return result, jax.tree.map(lambda _: True, result)

    def alone(tree: Any) -> Any:
        result = function(jax.tree.map(lambda x: x[..., None], tree))
        return jax.tree.map(lambda x: x[..., 0], result)

    return alone


# A CPU's caches hold the data of no more simulations than this.
_MOST_IN_A_TILE = 128


def in_tiles(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Make a function of arrays with a trailing batch run in parts on a CPU."""

    def tiled(tree: Any) -> Any:
        batch = jax.tree.leaves(tree)[0].shape[-1]
        size = max(n for n in range(1, _MOST_IN_A_TILE + 1) if batch % n == 0)
        if not on_cpu() or size < 16 or size == batch:
            return function(tree)
        tiles = batch // size
        split = lambda x: jnp.moveaxis(x.reshape(*x.shape[:-1], tiles, size), -2, 0)
        join = lambda x: jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], batch)
        return jax.tree.map(join, jax.lax.map(function, jax.tree.map(split, tree)))

    return tiled
