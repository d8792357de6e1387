"""Many runs in one program: vmapped, and sharded over devices."""

import dataclasses
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


@dataclasses.dataclass(frozen=True)
class Batch:
    """Functions that train many members, each a seed with its hyperparameters.

    Attributes:
      env: one environment.
      seeds: absolute seed number of each member.
      config: what runs.
      chunk: most iterations in one call of `advance`.
      init: () -> states, (padded, ...) each leaf.
      advance: (states, num_iterations) -> states, metrics (padded, chunk), of which
        the first `num_iterations` are written. Takes the states' memory.
      init_members: what `init` does, for other members of the same number.
      compiled: `advance`, compiled for such states; compiles once.
      devices: what the members are sharded over.
      sharding: of the states.
    """

    env: Any
    seeds: Sequence[int]
    config: Config
    chunk: int
    init: Callable[[], Any]
    advance: Callable[[Any, Any], Any]
    init_members: Callable[[Sequence[int], Sequence[Hyperparameters]], Any]
    compiled: Callable[[Any], Callable[[Any, Any], Any]]
    devices: Sequence[jax.Device]
    sharding: NamedSharding

    @property
    def num_members(self) -> int:
        """How many are asked for; arrays are padded to a multiple of the devices."""
        return len(self.seeds)

    @property
    def device_kind(self) -> str:
        """How many devices of which kind: "2 x cpu"."""
        return f"{len(self.devices)} x {self.devices[0].device_kind}"

    def compile(self, states: Any = None) -> tuple[Any, Callable[[Any, Any], Any]]:
        """The states to start from, and `advance`, compiled.

        Args:
          states: of the members, (members, ...), to go on from; default the first.
        """
        states = self.init() if states is None else self.place(states)
        states = jax.block_until_ready(states)
        return states, self.compiled(states)

    def of(
        self, seeds: Sequence[int], hyperparameters: Sequence[Hyperparameters]
    ) -> "Batch":
        """Other members, as many, for the same compiled program."""
        init = lambda: self.init_members(seeds, hyperparameters)
        return dataclasses.replace(self, init=init, seeds=seeds)

    def of_members(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """A function of one member's arrays, for all members: sharded as in training.

        Compiles when it is first called. Takes and gives padded arrays, (padded, ...).
        """
        mesh, spec = self.sharding.mesh, self.sharding.spec
        # Nothing passes between the members, so nothing is to be checked.
        return jax.jit(
            jax.shard_map(
                jax.vmap(function),
                mesh=mesh,
                in_specs=spec,
                out_specs=spec,
                check_vma=False,
            )
        )

    def train(
        self, advance: Callable[[Any, Any], Any], states: Any, first: int, count: int
    ) -> tuple[Any, dict[str, np.ndarray]]:
        """Some iterations, no more than a chunk.

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

    def place(self, states: Any) -> Any:
        """States of the members, (members, ...), padded and on their devices."""
        padding = -self.num_members % len(self.devices)
        pad = lambda x: jnp.concatenate([x, *[x[-1:]] * padding])
        return jax.device_put(jax.tree.map(pad, states), self.sharding)

    def trim(self, states: Any) -> Any:
        """States without the padding: (members, ...)."""
        return jax.tree.map(lambda x: x[: self.num_members], states)


def chunk_size(config: Config) -> int:
    """Iterations between two looks at a run: about 50 looks, 100 iterations at most."""
    return max(1, min(100, config.num_iterations // 50))


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
      ValueError: a bad configuration.
    """
    train.check(env, config)
    if hyperparameters is None:
        hyperparameters = [config.hyperparameters] * len(seeds)
    devices = list(devices or jax.devices())[: len(seeds)]
    padding = -len(seeds) % len(devices)
    pad = lambda values: [*values, *([values[-1]] * padding)]
    arrays = lambda seeds, hyperparameters: (
        np.array(pad(seeds), np.uint32),
        jax.tree.map(lambda *x: np.array(x, np.float32), *pad(hyperparameters)),
    )
    chunk = chunk_size(config)
    mesh = Mesh(np.array(devices), ("members",))

    def init_one(member: tuple[jax.Array, Hyperparameters]) -> train.TrainState:
        seed, hyperparameters = member
        return train.init(env, config, jax.random.key(seed), hyperparameters)

    def advance(states: Any, num_iterations: jax.Array) -> Any:
        # Jitted, it is traced once for the shapes and the loop: seconds less.
        step = jax.jit(jax.vmap(lambda state: train.iterate(env, config, state)))
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

    # No collective in the loop: each device trains its share of the members alone.
    spec = P("members")
    shard = lambda function, in_specs: jax.shard_map(
        function, mesh=mesh, in_specs=in_specs, out_specs=spec, check_vma=False
    )
    init = jax.jit(
        shard(jax.vmap(init_one), (spec,)), in_shardings=NamedSharding(mesh, spec)
    )
    init_members = lambda seeds, hyperparameters: init(arrays(seeds, hyperparameters))
    jitted = jax.jit(shard(advance, (spec, P())), donate_argnums=0)
    programs: list[Callable[[Any, Any], Any]] = []

    def compiled(states: Any) -> Callable[[Any, Any], Any]:
        if not programs:
            programs.append(jitted.lower(states, np.int32(0)).compile())
        return programs[0]

    return Batch(
        env=env,
        seeds=seeds,
        config=config,
        chunk=chunk,
        init=lambda: init_members(seeds, hyperparameters),
        advance=jitted,
        init_members=init_members,
        compiled=compiled,
        devices=devices,
        sharding=NamedSharding(mesh, spec),
    )
