"""The installed JAX computes correct numbers, and our permutations are its own."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gasil_jax
from gasil_jax import policy
from gasil_jax.permutation import argsort, permutation


@pytest.mark.compiled_as_for_users
def test_batched_reduction_is_right_on_cpu():
    """jax issue 39103: jaxlib 0.10.2 gives 1065369600 here."""
    rows = jnp.ones((32_769, 2), jnp.float32).at[:, 1].set(0.0)
    matrix = jnp.array([[128.0, 0.0], [0.0, 1.0]], jnp.float32)
    squares = jax.jit(jax.vmap(lambda row: jnp.sum((matrix @ row) ** 2)))(rows)
    assert bool(jnp.all(squares == 128.0**2))


@pytest.mark.compiled_as_for_users
def test_many_batched_orthogonal_matrices_do_not_deadlock():
    """Under jaxlib 0.10.1 several batched QR factorizations hang on CPU."""
    from gasil_jax.networks import orthogonal

    def six(seed):
        keys = jax.random.split(jax.random.key(seed), 6)
        return [orthogonal(1.0)(key, (64, 64)) for key in keys]

    for matrix in jax.jit(jax.vmap(six))(jnp.arange(8)):
        product = jnp.einsum("bij,bik->bjk", matrix, matrix)
        assert float(jnp.max(jnp.abs(product - jnp.eye(64)[None]))) < 1e-4


SETTINGS = {"num_envs": 2, "batch_steps": 4, "total_steps": 8, "minibatch_size": 2}
SETTINGS |= {"hidden_sizes": (4,), "discriminator_hidden_sizes": (4,), "num_epochs": 1}
SETTINGS |= {"discriminator_minibatch_size": 8, "discriminator_updates": 1}
ALGORITHM = gasil_jax.algorithm(**SETTINGS, buffer_steps=3)


@pytest.mark.compiled_as_for_users
def test_an_optimized_iteration_equals_a_plain_one():
    """Two of them: rollout, insertion, advantages, discriminator and PPO."""
    env = gasil_jax.make_env("point_mass", reward_delay=2, max_episode_steps=2)
    step = lambda state: gasil_jax.train_step(env, ALGORITHM, state)
    # As tests are compiled that have no mark; see conftest.py.
    less = {"backend_optimization_level": 0, "llvm_disable_expensive_passes": True}
    less = {f"xla_{name}": value for name, value in less.items()}
    init = jax.jit(lambda key: gasil_jax.init(env, ALGORITHM, key))
    first = init.lower(jax.random.key(0)).compile(less)(jax.random.key(0))
    lowered = jax.jit(step).lower(first)
    plain = lowered.compile(less)
    optimized = lowered.compile()
    state, _ = plain(first)
    assert int(state.agent.buffer.size) == 3
    number = lambda x: (
        jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    )
    ours, theirs = (jax.tree.map(number, each(state)) for each in (optimized, plain))
    close = functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5)
    jax.tree.map(close, ours, theirs)


def products(jaxpr):
    """The precision of every matrix product, in inner functions too."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            yield equation.params["precision"]
        # Of a scan, a jit, and so on, closed over constants or not.
        for inner in jax.tree.leaves(equation.params):
            inner = getattr(inner, "jaxpr", inner)
            if hasattr(inner, "eqns"):
                yield from products(inner)


def test_matrices_are_multiplied_in_full_precision():
    """Products are in full float32; by default a GPU uses TF32."""
    highest = jax.lax.Precision.HIGHEST
    env = gasil_jax.make_env("point_mass", max_episode_steps=2)
    init = lambda: gasil_jax.init(env, ALGORITHM, jax.random.key(0))
    state = jax.eval_shape(init)
    jaxpr = jax.make_jaxpr(lambda x: gasil_jax.train_step(env, ALGORITHM, x))(state)
    precisions = list(products(jaxpr.jaxpr))
    assert len(precisions) > 10
    assert set(precisions) == {(highest, highest)}
    act = policy.from_state(jax.jit(init)(), env)
    precisions = list(
        products(jax.make_jaxpr(act)(jnp.zeros(env.observation_size)).jaxpr)
    )
    assert precisions and set(precisions) == {(highest, highest)}
    # What the program asks for itself it gets.
    with jax.default_matmul_precision("default"):
        jaxpr = jax.make_jaxpr(lambda x: gasil_jax.train_step(env, ALGORITHM, x))(state)
    assert (highest, highest) not in set(products(jaxpr.jaxpr))


@pytest.mark.parametrize("size", [1, 7, 2048, 3000, 2**16 + 1])
def test_the_order_is_that_of_jax(size):
    key = jax.random.key(size)
    ours = jax.jit(permutation, static_argnums=1)(key, size)
    np.testing.assert_array_equal(ours, jax.random.permutation(key, size))
    assert ours.dtype == jnp.int32


@pytest.mark.parametrize("highest", [1, 3, 2**22, 2**32])
def test_argsort_is_stable(highest):
    keys = np.random.default_rng(0).integers(0, highest, 1000, dtype=np.uint32)
    np.testing.assert_array_equal(argsort(keys), np.argsort(keys, kind="stable"))
