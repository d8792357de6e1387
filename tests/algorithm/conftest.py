"""Arrays of different ranks are never combined without saying so."""

import jax
import pytest


@pytest.fixture(autouse=True)
def explicit_broadcasting():
    """Raise where JAX would add axes as NumPy does."""
    with jax.numpy_rank_promotion("raise"):
        yield
