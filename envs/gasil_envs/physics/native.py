"""MuJoCo physics in C, on the host's cores, from inside a jitted program.

A single host call by `jax.pure_callback`, with the batch axes of all `jax.vmap`s around
it, advances every environment of a device. The callback depends on its arguments alone
and uses NumPy only, because a JAX operation inside could deadlock. If MuJoCo raises an
error or a warning in a simulation, its result is NaN, which ends its episode.
"""

import collections
import concurrent.futures
import itertools
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import mujoco.batch
import numpy as np

from gasil_envs.physics import dynamics, host_threads
from gasil_envs.physics.batching import batch_last
from gasil_envs.physics.interface import Fields, PhysicsState

_STATE = ("qpos", "qvel", "qacc_warmstart")


class _BatchSimulations:
    """Simulations with MuJoCo's own `mujoco.batch.Batch`, which returns no fields.

    A step is from arrays of the state and "ctrl", (n, ...) each, to those of the state
    and the fields, and which simulations failed, bool (n,). One thread uses it at a
    time.
    """

    def __init__(self, model: mujoco.MjModel, count: int, threads: int):
        self._batch = mujoco.batch.Batch(model, count, threads)
        self._bound = {name: self._batch.bind(name) for name in (*_STATE, "ctrl")}

    def step(
        self, inputs: dict[str, np.ndarray], frame_skip: int
    ) -> tuple[dict[str, np.ndarray], np.ndarray]:
        for name, value in inputs.items():
            self._bound[name][...] = value
        self._batch.warning[...] = 0
        try:
            self._batch.step(nstep=frame_skip)
        except mujoco.batch.SimulationError as error:
            failed = np.isin(np.arange(self._batch.nsim), error.ids)
        else:
            failed = np.zeros(self._batch.nsim, bool)
        warned = self._batch.warning[..., -1].any(axis=-1)
        return {name: self._bound[name] for name in _STATE}, failed | warned


class _ThreadedSimulations:
    """The same with a thread and an `mujoco.MjData` for each share of them.

    They return fields, also contact forces, which `Batch` can't: ``cfrc_ext`` needs
    ``mj_rnePostConstraint`` after the step.
    """

    def __init__(
        self, model: mujoco.MjModel, count: int, threads: int, fields: Sequence[str]
    ):
        self._model, self._fields = model, tuple(fields)
        bounds = np.linspace(0, count, min(threads, count) + 1).astype(int)
        self._shares = list(itertools.pairwise(bounds))
        self._data = [mujoco.MjData(model) for _ in self._shares]
        self._pool = concurrent.futures.ThreadPoolExecutor(len(self._shares))

        self._results = {
            name: np.zeros((count, *getattr(self._data[0], name).shape))
            for name in _STATE + self._fields
        }
        self._failed = np.zeros(count, bool)

    def _advance(
        self,
        data: mujoco.MjData,
        share: tuple[int, int],
        inputs: dict[str, np.ndarray],
        frame_skip: int,
    ) -> None:
        sources = [(getattr(data, name), value) for name, value in inputs.items()]
        results = [(getattr(data, name), x) for name, x in self._results.items()]
        warned = data.warning.number
        for i in range(*share):
            for array, value in sources:
                array[...] = value[i]
            warned[...] = 0
            try:
                mujoco.mj_step(self._model, data, frame_skip)
                mujoco.mj_rnePostConstraint(self._model, data)
            except mujoco.FatalError:
                self._failed[i] = True
            else:
                self._failed[i] = warned.any()
            for array, value in results:
                value[i] = array

    def step(
        self, inputs: dict[str, np.ndarray], frame_skip: int
    ) -> tuple[dict[str, np.ndarray], np.ndarray]:
        work = [
            self._pool.submit(self._advance, data, share, inputs, frame_skip)
            for data, share in zip(self._data, self._shares)
        ]
        for one in work:
            one.result()
        return self._results, self._failed


class MujocoPhysics:
    """Steps a MuJoCo model with C MuJoCo; see `interface.Physics`.

    A host call has `threads`, by default the cores that this process may use, divided
    by the local devices of JAX's default backend.
    """

    name = "mujoco"

    def __init__(
        self, model: mujoco.MjModel, fields: Sequence[str] = (), threads: int = 0
    ):
        self._model, self._fields, self._threads = model, tuple(fields), threads
        data = mujoco.MjData(model)
        self._at_rest = {x: getattr(data, x).copy() for x in (*_STATE, "ctrl")}
        self._shapes = {x: getattr(data, x).shape for x in (*_STATE, *self._fields)}
        # By number of simulations. Devices call at the same time, and each call takes
        # its own simulations.
        self._idle: dict[int, list[Any]] = collections.defaultdict(list)
        # Initial states are computed far more often than they are used, so they are
        # computed without a host call.
        self._place = batch_last(partial(dynamics.kinematics, model, self._fields))

    def kinematics(self, state: PhysicsState) -> Fields:
        return self._place(state)

    def step(
        self, state: PhysicsState, control: jax.Array, frame_skip: int
    ) -> tuple[PhysicsState, Fields]:
        host_threads.check()
        cores = host_threads.available_cores()
        threads = self._threads or max(1, cores // jax.local_device_count())

        def on_host(*arrays: Any) -> dict[str, np.ndarray]:
            return self._advance([np.asarray(x) for x in arrays], frame_skip, threads)

        result = jax.pure_callback(
            on_host,
            {x: jax.ShapeDtypeStruct(y, jnp.float32) for x, y in self._shapes.items()},
            *(state.qpos, state.qvel, state.qacc_warmstart, control),
            vmap_method="broadcast_all",
        )
        state = PhysicsState(*(result[name] for name in _STATE))
        return state, {name: result[name] for name in self._fields}

    def _advance(
        self, arrays: list[np.ndarray], frame_skip: int, threads: int
    ) -> dict[str, np.ndarray]:
        batch = arrays[0].shape[:-1]
        inputs = {
            name: x.reshape(-1, x.shape[-1])
            for name, x in zip((*_STATE, "ctrl"), arrays, strict=True)
        }
        count = inputs["qpos"].shape[0]
        idle = self._idle[count]
        try:
            simulations = idle.pop()
        except IndexError:
            more = (self._model, count, threads)
            simulations = (
                _ThreadedSimulations(*more, self._fields)
                if self._fields
                else _BatchSimulations(*more)
            )
        # MuJoCo would print a warning for each of these that it is given.
        lost = ~np.all([np.isfinite(x).all(axis=-1) for x in inputs.values()], axis=0)
        if lost.any():
            inputs = {
                name: np.where(lost[:, None], self._at_rest[name], value)
                for name, value in inputs.items()
            }
        values, failed = simulations.step(inputs, frame_skip)
        failed = failed | lost
        results = {}
        for name, shape in self._shapes.items():
            # Copied before the next caller may use these simulations.
            result = np.array(values[name], np.float32)
            result[failed] = np.nan
            results[name] = result.reshape(batch + shape)
        idle.append(simulations)
        return results
