"""That the installed JAX computes what we ask of it."""

import jax
import jax.numpy as jnp


def test_batched_reduction_is_right_on_cpu():
    """jax issue 39103: jaxlib 0.10.2 gives 1065369600 here."""
    rows = jnp.ones((32_769, 2), jnp.float32).at[:, 1].set(0.0)
    matrix = jnp.array([[128.0, 0.0], [0.0, 1.0]], jnp.float32)
    squares = jax.jit(jax.vmap(lambda row: jnp.sum((matrix @ row) ** 2)))(rows)
    assert bool(jnp.all(squares == 128.0**2))


def test_many_batched_orthogonal_matrices_do_not_deadlock():
    """Under jaxlib 0.10.1 several batched QR factorizations hang on CPU."""
    from gasil_jax.networks import orthogonal

    def six(seed):
        keys = jax.random.split(jax.random.key(seed), 6)
        return [orthogonal(1.0)(key, (64, 64)) for key in keys]

    for matrix in jax.jit(jax.vmap(six))(jnp.arange(8)):
        product = jnp.einsum("bij,bik->bjk", matrix, matrix)
        assert float(jnp.max(jnp.abs(product - jnp.eye(64)))) < 1e-4
