"""Functions whose arrays have the batch as their last axis.

With 5 to 30 degrees of freedom the batch is the only axis of a simulation that is long
enough to fill vector units, so it is the last, the one that is contiguous in memory.
"""

import os
import re
from collections.abc import Callable, Iterable
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.layout import Layout, with_layout_constraint
from jax.experimental.xla_metadata import set_xla_metadata

_LOOPS = "xla_cpu_disable_loop_unrolling"


def keep_loops(physics: str) -> None:
    """Make XLA's CPU backend compile loops over a small batch to vector instructions.

    Otherwise XLA unrolls these loops and computes one number at a time: with 8 to 32
    environments our physics is then 2 to 3 times slower, and MJX by half faster. The
    option is of a whole process: it is added to the environment variable XLA_FLAGS, so
    call this before JAX starts.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if physics != "mjx" and "xla_backend_extra_options" not in flags:
        os.environ["XLA_FLAGS"] = (
            f"{flags} --xla_backend_extra_options={_LOOPS}".strip()
        )


def on_cpu() -> bool:
    """Whether programs are compiled for a CPU."""
    return jax.default_backend() == "cpu"


def has_triton() -> bool:
    """Whether programs are compiled for a GPU that Triton supports: Ampere or newer."""
    name = str(getattr(jax.devices()[0], "compute_capability", ""))
    is_nvidia = jax.default_backend() == "gpu" and re.fullmatch(r"\d+\.\d", name)
    return bool(is_nvidia) and float(name) >= 8.0


_identity = jax.jit(lambda tree: tree)


def keep_layout(x: jax.Array) -> jax.Array:
    """Keep XLA from storing an array with its axes in another order.

    On a GPU neighbouring threads have neighbouring numbers of the last axis, the batch.
    XLA does not know this, and chooses another order where that saves a transposition.
    """
    return with_layout_constraint(x, Layout(tuple(range(x.ndim))))


def materialize(tree: Any) -> Any:
    """Make arrays be computed once and stored, however often they are used.

    XLA's CPU backend fuses a chain of elementwise operations into each of its users and
    computes it again in each. It removes optimization barriers before it does, but
    does not look into a call that is not to be inlined.
    """
    if not on_cpu():
        return jax.tree.map(keep_layout, jax.lax.optimization_barrier(tree))
    with set_xla_metadata(inlineable="false"):
        return _identity(tree)


def add(terms: Iterable[jax.Array]) -> jax.Array:
    """Sum at least one array, spelled out."""
    # The type of `sum` does not express that there is one.
    return cast(jax.Array, sum(terms))


def sum_signed(values: Iterable[jax.Array], signs: Iterable[int]) -> jax.Array:
    """Sum arrays with constant signs -1, 0 or 1, which are not all 0."""
    pairs = zip(values, signs, strict=True)
    return add([value if sign > 0 else -value for value, sign in pairs if sign])


def total(x: jax.Array, axis: int = 0) -> jax.Array:
    """Sum over an axis other than the last, spelled out.

    XLA's CPU backend computes a reduction one number after the other. What is spelled
    out it computes for a whole vector of the batch at once.
    """
    return add(jax.lax.index_in_dim(x, i, axis, False) for i in range(x.shape[axis]))


def constant_times(matrix: np.ndarray, x: jax.Array) -> jax.Array:
    """Return a constant matrix (n, m) times (m, ..., B), without its zeros."""
    rows = [
        add([float(row[i]) * x[i] for i in np.flatnonzero(row)])
        if row.any()
        else jnp.zeros_like(x[0])
        for row in matrix
    ]
    return stacked(rows) if rows else x[:0]


def fold(function: Any, rows: jax.Array) -> jax.Array:
    """Combine rows by one of jax.numpy's ufuncs: (N, ..., B) -> (..., B).

    On a CPU it is computed for a whole vector of the batch at once, as `total` is, but
    is compiled for size.
    """
    if not on_cpu():
        return function.reduce(rows, axis=0)
    return jax.lax.fori_loop(
        1, rows.shape[0], lambda i, done: function(done, rows[i]), rows[0]
    )


def stacked(parts: Iterable[Any], axis: int = 0) -> jax.Array:
    """Stack arrays; on a CPU each of them is computed by itself before.

    A CPU's kernel that computes and stacks at once asks for each number which part it
    is of, and so computes one number after the other.
    """
    if not on_cpu():
        return jnp.stack(tuple(parts), axis)
    return materialize(jnp.stack(materialize(tuple(parts)), axis))


def take(x: jax.Array, index: Iterable[int]) -> jax.Array:
    """Return rows of the first axis by their constant indices.

    A CPU's kernel can hold no gather. On a GPU each number of a stack is searched among
    its parts, which takes long if there are many.
    """
    if not on_cpu():
        return x[np.asarray(list(index), int)]
    rows = [x[int(i)] for i in index]
    return jnp.stack(rows) if rows else x[:0]


def batch_last(
    function: Callable[[Any], Any], batched: Callable[[Any], Any] | None = None
) -> Callable[[Any], Any]:
    """Make `jax.vmap`, nested if needed, extend a trailing batch axis.

    `function` is of trees of arrays with a trailing batch, and what is returned of
    arrays without. `batched` is the same function, to be called under `jax.vmap`.
    """
    function = jax.custom_batching.custom_vmap(function)
    batched = jax.custom_batching.custom_vmap(batched or function)

    @function.def_vmap
    @batched.def_vmap
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
        result = materialize(batched(joined))
        result = jax.tree.map(part, result)
        return result, jax.tree.map(lambda _: True, result)

    def alone(tree: Any) -> Any:
        result = function(jax.tree.map(lambda x: x[..., None], tree))
        return jax.tree.map(lambda x: x[..., 0], result)

    return alone


# A CPU's vector registers hold 8 or 16 numbers; its first cache holds the data of no
# more than 32 simulations.
_LANES, _MOST_IN_A_TILE = 8, 32


def in_tiles(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Make a function of arrays with a trailing batch run in parts on a CPU.

    The parts are of equal size, a multiple of the lanes of a vector: the last one is
    padded with copies of the last entry. All of them are one kernel, because a kernel
    costs a microsecond to start and a step of physics has a thousand operations. So
    the function can have no matrix product, nor a sum over an axis.
    """

    def tiled(tree: Any) -> Any:
        batch = jax.tree.leaves(tree)[0].shape[-1]
        tiles = -(-batch // _MOST_IN_A_TILE)
        size = -(-batch // (tiles * _LANES)) * _LANES
        padding = tiles * size - batch

        def split(x: jax.Array) -> jax.Array:
            x = jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, padding)], mode="edge")
            return jnp.moveaxis(x.reshape(*x.shape[:-1], tiles, size), -2, 0)

        def join(x: jax.Array) -> jax.Array:
            return jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], -1)[..., :batch]

        parts = materialize(jax.tree.map(split, tree))
        if tiles == 1:

            def first(tree: Any) -> Any:
                return jax.tree.map(lambda x: x[0], tree)

            results = jax.tree.map(lambda x: x[None], function(first(parts)))
        else:
            results = jax.lax.map(function, parts)
        return jax.tree.map(join, results)

    def call(tree: Any) -> Any:
        if not on_cpu():
            return function(tree)
        with set_xla_metadata(inlineable="false", xla_cpu_small_call="true"):
            return jax.jit(tiled)(tree)

    return call
