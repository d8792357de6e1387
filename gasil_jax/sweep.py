"""Many seeds in one program: vmapped, and sharded over devices."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from gasil_jax import train
from gasil_jax.config import Config


def member(states: Any, index: int) -> Any:
    """One run out of a batch of them: the leading axis of every leaf is taken away."""
    return jax.tree.map(lambda x: x[index], states)


@dataclasses.dataclass(frozen=True)
class SeedBatch:
    """Compiled functions that train a batch of seeds on all devices.

    Attributes:
      num_seeds: seeds asked for; batches are padded to a multiple of the devices.
      init: (seeds uint32 (padded,)) -> states.
      advance: (states, num_iterations) -> states, metrics (seeds, chunk), of which
        the first `num_iterations` are written.
      seeds: uint32 (padded,), the absolute seed numbers, padding at the end.
      devices: what the seeds are sharded over.
    """

    num_seeds: int
    init: Callable[[jax.Array], Any]
    advance: Callable[[Any, int], Any]
    seeds: np.ndarray
    devices: Sequence[jax.Device]


def make_seed_batch(
    env: Any,
    config: Config,
    seeds: Sequence[int],
    *,
    chunk: int,
    devices: Sequence[jax.Device] | None = None,
) -> SeedBatch:
    """Prepare to train `seeds` side by side, sharded over `devices`.

    A seed's key is ``jax.random.key(seed)``, whatever its place in the batch and
    the device it runs on. Nothing is compiled yet: `init` and `advance` are jitted.

    Args:
      env: one environment.
      config: what to run.
      seeds: absolute seed numbers.
      chunk: most iterations in one call of `advance`.
      devices: default all; no more of them are used than there are seeds.
    """
    train.validate(config, tuple(train.AGENTS))
    devices = list(devices or jax.devices())[: len(seeds)]
    padding = -len(seeds) % len(devices)
    padded = np.array([*seeds, *([seeds[-1]] * padding)], np.uint32)
    mesh = Mesh(np.array(devices), ("seeds",))

    def init_one(seed: jax.Array) -> train.TrainState:
        return train.init(env, config, jax.random.key(seed))

    def advance(states: Any, num_iterations: jax.Array) -> Any:
        step = jax.vmap(lambda state: train.iterate(env, config, state))
        metrics = jax.eval_shape(step, states)[1]
        metrics = jax.tree.map(
            lambda x: jnp.full((x.shape[0], chunk), jnp.nan, x.dtype), metrics
        )

        def body(index: jax.Array, carry: Any) -> Any:
            states, metrics = carry
            states, new = step(states)
            write = lambda all_, one: jax.lax.dynamic_update_index_in_dim(
                all_, one, index, 1
            )
            return states, jax.tree.map(write, metrics, new)

        return jax.lax.fori_loop(0, num_iterations, body, (states, metrics))

    # No collective in the loop: each device trains its share of the seeds alone.
    shard = lambda function, in_specs: jax.shard_map(
        function, mesh=mesh, in_specs=in_specs, out_specs=P("seeds"), check_vma=False
    )
    sharding = NamedSharding(mesh, P("seeds"))
    init = jax.jit(shard(jax.vmap(init_one), P("seeds")), in_shardings=sharding)
    advance = jax.jit(shard(advance, (P("seeds"), P())), donate_argnums=0)
    return SeedBatch(len(seeds), init, advance, padded, devices)
