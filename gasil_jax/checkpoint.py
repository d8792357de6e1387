"""Save and load training states with Orbax."""

import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _as_arrays(state: Any) -> dict[str, Any]:
    """Leaves by their path in the state; typed keys as what they hold."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(state)
    return {
        jax.tree_util.keystr(path): jax.random.key_data(x) if _is_key(x) else x
        for path, x in leaves
    }


def save(folder: pathlib.Path, state: Any) -> None:
    """Write `state`, a pytree of arrays, to `folder`, which must not exist."""
    arrays = jax.tree.map(np.asarray, _as_arrays(state))
    with ocp.StandardCheckpointer() as checkpointer:
        checkpointer.save(folder.absolute(), arrays)


def restore(folder: pathlib.Path, like: Any) -> Any:
    """Read what `save` wrote.

    Args:
      folder: where it is.
      like: a state of the same structure, shapes and dtypes; its leaves may be
        `jax.ShapeDtypeStruct`.

    Raises:
      ValueError: it is a state of another structure, shape or dtype.
    """
    with ocp.StandardCheckpointer() as checkpointer:
        arrays = checkpointer.restore(folder.absolute())
    wanted = jax.eval_shape(_as_arrays, like)
    # Orbax may restore a part of a tree that does not match, without a word.
    shape = lambda tree: {name: (x.shape, str(x.dtype)) for name, x in tree.items()}
    if shape(arrays) != shape(wanted):
        names = set(arrays) ^ set(wanted) or {
            name for name in wanted if shape(arrays)[name] != shape(wanted)[name]
        }
        raise ValueError(f"{folder} holds another state: {min(names)} differs")
    leaves, structure = jax.tree_util.tree_flatten_with_path(like)
    values = [
        jax.random.wrap_key_data(arrays[jax.tree_util.keystr(path)])
        if _is_key(x)
        else jnp.asarray(arrays[jax.tree_util.keystr(path)])
        for path, x in leaves
    ]
    return jax.tree.unflatten(structure, values)
