"""Write policy.npz, the trained policies of a run."""

import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from gasil_jax import numpy_policy, policy
from gasil_jax.host import output_file


def save(
    path: pathlib.Path,
    states: Any,
    env: Any,
    seeds: Sequence[int],
    final_return: np.ndarray,
) -> None:
    """Write the policies of training states, (seeds, ...), to one ``.npz`` file."""
    weights = policy.weights(states, env)
    if "network" in weights:
        output_file.note(f"{path.name} is not written: {numpy_policy.OWN_NETWORK}")
        return
    arrays: dict[str, Any] = {
        "seeds": np.asarray(seeds, np.int64),
        "final_return": np.asarray(final_return, np.float64),
        **weights,
    }
    with output_file.atomic(path) as partial, partial.open("wb") as file:
        np.savez(file, **arrays)
