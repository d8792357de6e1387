"""Random permutations equal to those of `jax.random.permutation`, faster on a CPU.

JAX sorts the numbers by random keys of 32 bits. On a CPU, XLA sorts a single array
several times as fast as an array of keys with an array of values, and PPO draws a
permutation in each of its epochs.
"""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp

# A larger index would leave too few of a key's 32 bits.
_MAX_SIZE = 2**16


@jax.named_scope("permutation")
def permutation(key: jax.Array, size: int) -> jax.Array:
    """Return the numbers below `size` in random order, int32 (size,).

    The order is that of `jax.random.permutation`. The key is consumed.
    """
    of_jax = functools.partial(jax.random.permutation, x=size)
    if not 1 < size <= _MAX_SIZE:
        return of_jax(key)
    ours = functools.partial(_by_packed_keys, size=size)
    return jax.lax.platform_dependent(key, cpu=ours, default=of_jax)


def _by_packed_keys(key: jax.Array, size: int) -> jax.Array:
    # The same number of rounds as in JAX; several make equal keys unimportant.
    rounds = math.ceil(3.0 * math.log(size) / math.log(2**32 - 1))

    def shuffle(_: int, carry: tuple[jax.Array, jax.Array]) -> Any:
        key, numbers = carry
        key, round_key = jax.random.split(key)
        return key, numbers[argsort(jax.random.bits(round_key, (size,)))]

    numbers = jnp.arange(size, dtype=jnp.int32)
    return jax.lax.fori_loop(0, rounds, shuffle, (key, numbers))[1]


def argsort(keys: jax.Array) -> jax.Array:
    """Return the indices that sort random keys, stably, int32 (size,).

    The keys' high bits are sorted with the indices in the place of the low bits. The
    few neighbours with the same high bits are then put in order by exchanges.

    Args:
      keys: uint32 (size,), at most 2**16 of them. The result is right for any keys;
        the function is fast for random ones.
    """
    size = keys.shape[0]
    low_bits = jnp.uint32(2 ** (size - 1).bit_length() - 1)
    index = jnp.arange(size, dtype=jnp.uint32)
    packed = jax.lax.sort((keys & ~low_bits) | index, is_stable=False)
    order = (packed & low_bits).astype(jnp.int32)
    is_left = [index % 2 == parity for parity in (0, 1)]

    def is_unsorted(state: Any) -> jax.Array:
        sorted_keys, _ = state
        return jnp.any(sorted_keys[:-1] > sorted_keys[1:])

    def exchange(state: Any) -> Any:
        for left in is_left:
            inverted = state[0][:-1] > state[0][1:]
            takes_next = jnp.append(inverted, False) & left
            takes_last = jnp.append(False, inverted) & ~left
            state = tuple(
                jnp.where(
                    takes_next,
                    jnp.roll(x, -1),
                    jnp.where(takes_last, jnp.roll(x, 1), x),
                )
                for x in state
            )
        return state

    return jax.lax.while_loop(is_unsorted, exchange, (keys[order], order))[1]
