"""Many runs in one program: vmapped, and sharded over devices."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from gasil_jax import train
from gasil_jax.config import Config, Hyperparameters


def member(states: Any, index: int) -> Any:
    """One run out of a batch of them: the leading axis of every leaf is taken away."""
    return jax.tree.map(lambda x: x[index], states)


def init_member(
    env: Any, config: Config, seed: jax.Array, hyperparameters: Hyperparameters
) -> train.TrainState:
    """The first state of a member. Its key is of its seed number alone."""
    return train.init(env, config, jax.random.key(seed), hyperparameters)


def advance_members(
    env: Any, config: Config, states: Any, num_iterations: jax.Array
) -> tuple[Any, train.Metrics]:
    """Train members side by side for at most `chunk_size(config)` iterations.

    Args:
      env: one environment.
      config: of all members.
      states: (members, ...) each leaf.
      num_iterations: int32 (), how many.

    Returns:
      the states after them, and metrics (members, chunk), of which the first
      `num_iterations` are written and the others NaN.
    """
    # Jitted, it is traced once for the shapes and the loop: seconds less.
    step = jax.jit(jax.vmap(lambda state: train.iterate(env, config, state)))
    chunk = chunk_size(config)
    metrics = jax.tree.map(
        lambda x: jnp.full((x.shape[0], chunk), jnp.nan, x.dtype),
        jax.eval_shape(step, states)[1],
    )

    def body(index: jax.Array, carry: Any) -> Any:
        states, metrics = carry
        states, new = step(states)
        write = lambda all_, one: jax.lax.dynamic_update_index_in_dim(
            all_, one, index, 1
        )
        return states, jax.tree.map(write, metrics, new)

    return jax.lax.fori_loop(0, num_iterations, body, (states, metrics))


def chunk_size(config: Config) -> int:
    """Iterations between two looks at a run: about 50 looks, 100 iterations at most."""
    return max(1, min(100, config.num_iterations // 50))


@dataclasses.dataclass(frozen=True)
class Batch:
    """Members that train in one program, each a seed with its hyperparameters.

    Arrays of all members are padded to a multiple of the devices: (padded, ...).

    Attributes:
      env: one environment.
      config: what runs.
      seeds: absolute seed number of each member.
      hyperparameters: of each member.
      devices: what the members are sharded over.
    """

    env: Any
    config: Config
    seeds: Sequence[int]
    hyperparameters: Sequence[Hyperparameters]
    devices: Sequence[jax.Device]

    @property
    def num_members(self) -> int:
        """How many members there are, without the padding."""
        return len(self.seeds)

    @property
    def chunk(self) -> int:
        """Most iterations in one call of `advance`."""
        return chunk_size(self.config)

    @property
    def device_kind(self) -> str:
        """How many devices of which kind: "2 x cpu"."""
        return f"{len(self.devices)} x {self.devices[0].device_kind}"

    @functools.cached_property
    def sharding(self) -> NamedSharding:
        """Of the states: each device has its share of the members."""
        return NamedSharding(Mesh(np.array(self.devices), ("members",)), P("members"))

    def _shard(self, function: Callable[..., Any], in_specs: Any) -> Callable[..., Any]:
        # Nothing passes between the members, so nothing is to be checked.
        return jax.shard_map(
            function,
            mesh=self.sharding.mesh,
            in_specs=in_specs,
            out_specs=P("members"),
            check_vma=False,
        )

    def init(self) -> Any:
        """The first states of all members, (padded, ...) each leaf."""
        pad = lambda values: [*values, *[values[-1]] * self._padding]
        init_one = lambda seed, hyperparameters: init_member(
            self.env, self.config, seed, hyperparameters
        )
        init = jax.jit(
            self._shard(jax.vmap(init_one), P("members")), in_shardings=self.sharding
        )
        return init(
            np.array(pad(self.seeds), np.uint32),
            jax.tree.map(
                lambda *x: np.array(x, np.float32), *pad(self.hyperparameters)
            ),
        )

    @functools.cached_property
    def advance(self) -> Any:
        """`advance_members`, jitted and sharded: it takes the states' memory."""
        advance = functools.partial(advance_members, self.env, self.config)
        return jax.jit(self._shard(advance, (P("members"), P())), donate_argnums=0)

    def compile(self, states: Any = None) -> tuple[Any, Callable[[Any, Any], Any]]:
        """The states to start from, and `advance`, compiled.

        Args:
          states: of the members, (members, ...), to go on from; default the first.
        """
        states = self.init() if states is None else self.place(states)
        states = jax.block_until_ready(states)
        return states, self.advance.lower(states, np.int32(0)).compile()

    def of_members(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """A function of one member's arrays, for all members: sharded as in training.

        Compiles when it is first called. Takes and gives padded arrays, (padded, ...).
        """
        return jax.jit(self._shard(jax.vmap(function), P("members")))

    def train(
        self, advance: Callable[[Any, Any], Any], states: Any, first: int, count: int
    ) -> tuple[Any, dict[str, np.ndarray]]:
        """Train for some iterations, no more than a chunk.

        Args:
          advance: compiled.
          states: before them; their memory is taken.
          first: iterations done already.
          count: how many to do.

        Returns:
          the states after them, and their metrics, (members, iterations) each;
          "env_steps" are whole numbers.
        """
        states, metrics = advance(states, np.int32(count))
        metrics = {
            name: np.asarray(value)[: self.num_members, :count]
            for name, value in metrics.items()
        }
        # float32 counts exactly only to 2**24.
        steps = (np.arange(first, first + count) + 1) * self.config.batch_steps
        metrics["env_steps"] = np.broadcast_to(steps, (self.num_members, count))
        return states, metrics

    @property
    def _padding(self) -> int:
        return -self.num_members % len(self.devices)

    def place(self, states: Any) -> Any:
        """States of the members, (members, ...), padded and on their devices."""
        pad = lambda x: jnp.concatenate([x, *[x[-1:]] * self._padding])
        return jax.device_put(jax.tree.map(pad, states), self.sharding)

    def trim(self, states: Any) -> Any:
        """States without the padding: (members, ...)."""
        return jax.tree.map(lambda x: x[: self.num_members], states)


def make_batch(
    env: Any,
    config: Config,
    seeds: Sequence[int],
    hyperparameters: Sequence[Hyperparameters] | None = None,
    *,
    devices: Sequence[jax.Device] | None = None,
) -> Batch:
    """Prepare to train members side by side, sharded over `devices`.

    A member's key is ``jax.random.key(seed)``, whatever its place in the batch and
    the device it runs on. Nothing is compiled yet.

    Args:
      env: one environment.
      config: what to run.
      seeds: absolute seed number of each member.
      hyperparameters: of each member; default the config's for all.
      devices: default all; no more of them are used than there are members.

    Raises:
      ValueError: the configuration is bad.
    """
    train.check(env, config)
    if hyperparameters is None:
        hyperparameters = [config.hyperparameters] * len(seeds)
    devices = list(devices or jax.devices())[: len(seeds)]
    return Batch(env, config, seeds, hyperparameters, devices)
