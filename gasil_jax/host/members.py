"""Train many members in one compiled program: vmapped, and sharded over devices.

A member is a seed with its hyperparameters. Its random numbers come from its seed
alone, not from the members beside it or from the device it runs on.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent import futures
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from gasil_envs.precision import full_precision
from gasil_jax import train
from gasil_jax.algorithms import Algorithm
from gasil_jax.config import Config, Range
from gasil_jax.errors import refusal
from gasil_jax.host import resources


def member(states: Any, index: int) -> Any:
    """Return the state of one member: entry `index` of the first axis of each leaf.

    Raises:
      IndexError: if there is no such entry. JAX alone would return the last one.
      ValueError: if the index is no whole number, or the states have no axis.
    """
    traced = isinstance(index, jax.Array) and jnp.issubdtype(index.dtype, np.integer)
    if index not in Range(-math.inf, whole=True) and not traced:
        raise refusal("index", index, "a whole number")
    shapes = [np.shape(leaf) for leaf in jax.tree.leaves(states)]
    if not shapes or not all(shapes):
        raise refusal("states", states, "arrays with an axis of members")
    count = shapes[0][0]
    if not traced and not -count <= index < count:
        raise IndexError(f"index is {index}: there are {count} states")
    return jax.tree.map(lambda x: x[index], states)


def advance_members(
    env: Any, algorithm: Algorithm, states: Any, num_iterations: jax.Array, data: Any
) -> tuple[Any, train.Metrics]:
    """Train members for some iterations; metrics are (members, chunk), then NaN."""
    # A jitted function is traced once for both uses, which saves seconds.
    step = jax.jit(
        jax.vmap(lambda state: train.train_step(env, algorithm, state, data=data))
    )
    chunk = chunk_size(algorithm.config)
    metrics = jax.tree.map(
        lambda x: jnp.full((x.shape[0], chunk), jnp.nan, x.dtype),
        jax.eval_shape(step, states)[1],
    )

    def body(index: jax.Array, carry: Any) -> Any:
        states, metrics = carry
        states, new = step(states)

        def write(all_: jax.Array, one: jax.Array) -> jax.Array:
            return jax.lax.dynamic_update_index_in_dim(all_, one, index, 1)

        return states, jax.tree.map(write, metrics, new)

    return jax.lax.fori_loop(0, num_iterations, body, (states, metrics))


def chunk_size(config: Config) -> int:
    """Return how many iterations one call trains: a fiftieth of all, at most 100."""
    return max(1, min(100, config.num_iterations // 50))


@dataclasses.dataclass(frozen=True)
class Members:
    """The members that train in one program; their arrays are padded: (padded, ...)."""

    env: Any  # one environment
    algorithm: Algorithm  # the algorithm that the members share
    seeds: Sequence[int]  # absolute seed number of each member
    hyperparameters: Sequence[Mapping[str, Any]]  # the numbers of each member, by name
    devices: Sequence[jax.Device]  # the devices that the members are sharded over

    @property
    def config(self) -> Config:
        """The settings of the training loop and of PPO that the members share."""
        return self.algorithm.config

    @property
    def num_members(self) -> int:
        """The number of members, without the padding."""
        return len(self.seeds)

    def env_steps(self, iterations: int) -> int:
        """Return the environment steps of all members in some iterations."""
        return iterations * self.config.batch_steps * self.num_members

    @property
    def chunk(self) -> int:
        """The largest number of iterations in one call of `advance`."""
        return chunk_size(self.config)

    @property
    def device_kind(self) -> str:
        """The number and kind of the devices, such as "2 x cpu"."""
        return f"{len(self.devices)} x {self.devices[0].device_kind}"

    @functools.cached_property
    def sharding(self) -> NamedSharding:
        """The sharding of all arrays: each device has its share of the members."""
        return NamedSharding(Mesh(np.array(self.devices), ("members",)), P("members"))

    def _sharding_of(self, leaf: Any) -> NamedSharding:
        # JAX gives all devices an array of no size.
        return self.sharding if leaf.size else NamedSharding(self.sharding.mesh, P())

    def _shard(self, function: Callable[..., Any], in_specs: Any) -> Callable[..., Any]:
        # Members do not communicate, so there is no replication to check.
        return jax.shard_map(
            function,
            mesh=self.sharding.mesh,
            in_specs=in_specs,
            out_specs=P("members"),
            check_vma=False,
        )

    @functools.cached_property
    def first_states(self) -> Any:
        """The jitted function of seeds and hyperparameters, (padded,), for `init`."""

        @full_precision
        def init_one(seed: Any, hyperparameters: Any) -> Any:
            algorithm = self.algorithm.replace(**hyperparameters)
            return train.first_state(self.env, algorithm, jax.random.key(seed))

        return jax.jit(
            self._shard(jax.vmap(init_one), P("members")), in_shardings=self.sharding
        )

    def init(self) -> Any:
        """Return the first states of all members, (padded, ...) each leaf."""

        def pad(values: Any) -> Any:
            return [*values, *[values[-1]] * self._padding]

        return self.first_states(
            np.array(pad(self.seeds), np.uint32),
            jax.tree.map(
                lambda *x: np.array(x, np.float32), *pad(self.hyperparameters)
            ),
        )

    @functools.cached_property
    def advance(self) -> Any:
        """`advance_members`, jitted and sharded; it reuses the memory of its input."""
        advance = functools.partial(advance_members, self.env, self.algorithm)
        specs = P("members"), P(), P()
        return jax.jit(self._shard(advance, specs), donate_argnums=0)

    @functools.cached_property
    def data(self) -> Any:
        """The agent's data, once on each device."""
        everywhere = NamedSharding(self.sharding.mesh, P())
        return jax.device_put(self.algorithm.agent.data(), everywhere)

    def compile(self, states: Any = None) -> tuple[Any, Callable[..., Any]]:
        """Return the states to start from, (padded, ...), and `advance`, compiled."""
        shapes = jax.tree.map(
            lambda x: x.update(sharding=self._sharding_of(x)),
            jax.eval_shape(self.init),
        )
        arguments = shapes, np.int32(0), self.data
        traced = self.advance.trace(*arguments)
        resources.check_arrays(traced.jaxpr.jaxpr, self.algorithm, self.devices)

        def first() -> Any:
            moved = self.init() if states is None else self.to_devices(states)
            return jax.block_until_ready(moved)

        # In threads, so that this one can answer to signals. The first states have a
        # program of their own, which takes seconds too.
        pool = futures.ThreadPoolExecutor()
        compiled = pool.submit(lambda: traced.lower().compile())
        return pool.submit(first).result(), compiled.result()

    def vmap(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function of one member for all, (padded, ...), sharded likewise."""
        return jax.jit(self._shard(jax.vmap(function), P("members")))

    def train(
        self, advance: Callable[..., Any], states: Any, first: int, count: int
    ) -> tuple[Any, dict[str, np.ndarray]]:
        """Train for `count` iterations, at most `chunk`, after the `first` ones.

        The memory of the states is reused. Metrics are (members, iterations) each, and
        "env_steps" holds whole numbers.
        """
        states, metrics = advance(states, np.int32(count), self.data)
        metrics = {
            name: np.asarray(value)[: self.num_members, :count]
            for name, value in metrics.items()
        }
        # Counted here, because float32 is exact only up to 2**24.
        steps = (np.arange(first, first + count) + 1) * self.config.batch_steps
        metrics["env_steps"] = np.broadcast_to(steps, (self.num_members, count))
        return states, metrics

    @property
    def _padding(self) -> int:
        return -self.num_members % len(self.devices)

    def to_devices(self, states: Any) -> Any:
        """Return the members' arrays, (members, ...), padded and on their devices."""
        padded = np.arange(self.num_members + self._padding)
        index = np.minimum(padded, self.num_members - 1)

        # Not on one device first, whose memory may hold only its share.
        def padded_rows(x: Any) -> Any:
            return x[index] if self._padding else x

        padded_states = jax.tree.map(padded_rows, states)
        return jax.device_put(
            padded_states, jax.tree.map(self._sharding_of, padded_states)
        )

    def trim(self, states: Any) -> Any:
        """Return the members' arrays without the padding, (members, ...)."""
        if not self._padding:
            return states

        # JAX would copy all rows to all devices, whose memory may hold only a share.
        def rows(leaf: Any) -> Any:
            if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
                return jax.random.wrap_key_data(rows(jax.random.key_data(leaf)))
            return np.asarray(leaf)[: self.num_members]

        return jax.tree.map(rows, states)

    def shapes(self) -> Any:
        """Return the shapes and dtypes of the members' states, (members, ...) each."""

        def resized(x: Any) -> Any:
            return x.update(shape=(self.num_members, *x.shape[1:]))

        return jax.tree.map(resized, jax.eval_shape(self.init))


class Interval:
    """Environment steps of a seed, rounded up to iterations; None is no interval."""

    def __init__(self, env_steps: int | None, config: Config):
        self.length, self._last = math.inf, config.num_iterations
        if env_steps is not None:
            self.length = math.ceil(env_steps / config.batch_steps)

    def left(self, done: int) -> float:
        """Return the iterations from `done` to the next end, at least one."""
        return self.length - done % self.length

    def ends(self, done: int) -> bool:
        """Return whether an interval ends after `done` iterations."""
        return done % self.length == 0

    def is_due(self, done: int) -> bool:
        """Return whether an interval ends, or training, after `done` iterations."""
        return self.ends(done) or done == self._last


def make_members(
    env: Any,
    algorithm: Algorithm,
    seeds: Sequence[int],
    hyperparameters: Sequence[Mapping[str, Any]] | None = None,
    *,
    devices: Sequence[jax.Device] | None = None,
) -> Members:
    """Return members to train side by side, by default on all devices."""
    every = hyperparameters or [{}] * len(seeds)
    numbers = [{**algorithm.hyperparameters, **one} for one in every]
    devices = list(devices or jax.devices())[: len(seeds)]
    return Members(env, algorithm, seeds, numbers, devices)
