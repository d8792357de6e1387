"""Compare the physics with C MuJoCo, beside C with what float32 leaves of its input."""

import collections
import contextlib
import copy
import dataclasses
import logging
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from generated_models import draw
from plain_numpy import Program

from gasil_envs.physics import batching, dynamics, mjx, newton_batch, ours
from gasil_envs.physics.interface import PhysicsState


def load(xml):
    """Return the model in an XML text or in a file."""
    text = str(xml).lstrip().startswith("<")
    load = mujoco.MjModel.from_xml_string if text else mujoco.MjModel.from_xml_path
    return load(str(xml))


def tight(model):
    """Make C's own solver iterate until it has converged."""
    model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    model.opt.iterations, model.opt.ls_iterations = 200, 200
    model.opt.tolerance = 1e-14
    return model


def units(model):
    """Return the size of a typical change of qpos and qvel.

    It is 1 for angles, and for lengths some times that of a body, but 1 at most.
    """
    length = min(1.0, 5 * model.stat.meansize)
    of_qpos, of_qvel = np.ones(model.nq), np.ones(model.nv)
    for joint in range(model.njnt):
        kind = int(model.jnt_type[joint])  # Not found as MuJoCo's own integer.
        width = {mujoco.mjtJoint.mjJNT_FREE: 3, mujoco.mjtJoint.mjJNT_SLIDE: 1}
        for x, first in ((of_qpos, model.jnt_qposadr), (of_qvel, model.jnt_dofadr)):
            x[first[joint] : first[joint] + width.get(kind, 0)] = length
    return of_qpos, of_qvel


def starts(model, count, seed=0, scale=0.1):
    """Return positions, velocities and controls, (count, ...) each."""
    rng = np.random.default_rng(seed)
    of_qpos, of_qvel = units(model)
    qpos = model.qpos0 + scale * of_qpos * rng.normal(size=(count, model.nq))
    for row in qpos:
        mujoco.mj_normalizeQuat(model, row)
    low, high = np.where(
        model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [-1.0, 1.0]
    ).T
    control = rng.uniform(low, high, (count, model.nu))
    qvel = 5 * scale * of_qvel * rng.normal(size=(count, model.nv))
    return qpos, qvel, control


def rounded(model):
    """Return a model whose numbers are those of float32."""
    model = copy.copy(model)
    for name in dir(model):
        values = getattr(model, name)
        if isinstance(values, np.ndarray) and values.dtype == np.float64:
            values[...] = np.float32(values)
    model.opt.gravity[:] = np.float32(model.opt.gravity)
    return model


def touch_twice(model, data):
    """Whether two capsules touch in two points: C's do within 1e-4 rad of parallel."""
    capsules = model.geom_type[data.contact.geom] == mujoco.mjtGeom.mjGEOM_CAPSULE
    pairs = data.contact.geom[capsules.all(axis=1)]
    return len(np.unique(pairs, axis=0)) < len(pairs)


def of_c(model, qpos, qvel, control, steps, fields=(), *, rounds=False):
    """Return qpos, qvel and fields of C MuJoCo after steps; NaN if it fails.

    Also NaN if capsules touch twice, which the documentation says is not ours. With
    `rounds` the state is rounded to float32 after each step.
    """
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, control
    differs = False
    for _ in range(steps):
        mujoco.mj_step(model, data)
        differs |= touch_twice(model, data)
        for x in (data.qpos, data.qvel, data.qacc_warmstart) if rounds else ():
            x[:] = np.float32(x)
    differs |= bool(data.warning.number.any())
    if fields:
        mujoco.mj_rnePostConstraint(model, data)
    state = np.concatenate([data.qpos, data.qvel])
    if differs:
        state[:] = np.nan
    found = {name: getattr(data, name).copy() for name in fields}
    # What they are rounded to: a force is no more exact than those that it balances.
    largest = {name: np.abs(x).max(initial=1.0) for name, x in found.items()}
    forces = np.abs(data.qfrc_smooth).max(initial=1.0)
    largest |= {x: max(largest[x], forces) for x in largest if x == "qfrc_constraint"}
    return state, {name: (x, largest[name]) for name, x in found.items()}


@dataclasses.dataclass
class Difference:
    """Errors, max |a - b| / (unit + |b|), of a model's states after some steps."""

    steps: int
    error: np.ndarray
    sensitivity: np.ndarray

    @property
    def excess(self):
        """The largest error beyond 30 times what rounding makes of C."""
        chaotic = self.sensitivity > 1e-3
        error = np.where(chaotic, 0.0, self.error - 30 * self.sensitivity)
        return float(np.max(error, initial=0.0))


def relative(a, b, unit=1.0):
    return float(np.max(np.abs(a - b) / (unit + np.abs(b)), initial=0.0))


def compare(
    model, count=4, seed=0, *, fields=(), steps=(1, 50), dtype=np.float32, engine=None
):
    """Return the differences of our physics after each number of steps.

    Those after the first also count the fields, relative to the largest of each.
    `engine` is another one: (state, control) -> state and fields, of batches that are
    last.
    """
    own = None if engine else dynamics.make(model, fields, 100, 30)
    advance = engine or (lambda state, control: dynamics.step(own, state, control, 1))
    qpos, qvel, control = starts(model, count, seed)
    state = PhysicsState(qpos.T, qvel.T, 0 * qvel.T)
    single = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (state, control.T))
    with products_at_once():
        step = Program(advance, *single)
    start = [x.astype(np.float32).astype(np.float64) for x in (qpos, qvel, control)]
    results, of_fields = [], {}
    for i in range(steps[-1]):
        state, seen = step(state, control.T, dtype=dtype)
        if i == 0:
            of_fields = seen
        if i + 1 in steps:
            results.append((i + 1, np.concatenate([state.qpos, state.qvel]).T))
    rng, (of_qpos, of_qvel) = np.random.default_rng(1), units(model)
    unit, nearly = np.concatenate([of_qpos, of_qvel]), rounded(model)
    differences = []
    for number, ours_ in results:
        error, sensitivity = [], []
        for k in range(count):
            right, right_fields = of_c(
                model, *(x[k] for x in start), number, fields if number == 1 else ()
            )
            if not np.isfinite(right).all():
                continue
            own_error = relative(ours_[k], right, unit)
            for name, (x, size) in right_fields.items():
                own_error = max(
                    own_error, relative(of_fields[name][..., k] / size, x / size)
                )
            error.append(own_error if np.isfinite(own_error) else np.inf)
            near = []
            for _ in range(3):
                moved = [
                    x[k]
                    + 1e-7 * np.sign(rng.normal(size=x[k].shape)) * (u + np.abs(x[k]))
                    for x, u in zip(start, (of_qpos, of_qvel))
                ]
                other = of_c(nearly, *moved, start[2][k], number, rounds=True)[0]
                near.append(relative(other, right, unit))
            sensitivity.append(np.nan_to_num(np.max(near), nan=np.inf))
        differences.append(Difference(number, np.array(error), np.array(sensitivity)))
    return differences


@contextlib.contextmanager
def products_at_once():
    """Trace products of matrices as one operation each, and a batch as one tile.

    NumPy has a word for such a product, and takes as long for one tile as for many.
    """

    def symmetric(left, right, spell_out):
        return jnp.einsum("nib,njb->ijb", left, right)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batching, "_MOST_IN_A_TILE", 10**6)
        patch.setattr(newton_batch, "_symmetric_product", symmetric)
        for name, axes in (("", "nvb,vb->nb"), ("_transposed", "nvb,nb->vb")):
            product = lambda m, v, spell_out, axes=axes: jnp.einsum(axes, m, v)
            patch.setattr(newton_batch, f"_matvec{name}", product)
        yield


def of_mjx(model):
    """Return MJX's step of a model; None if it refuses."""
    try:
        physics = mjx.MjxPhysics(model, (), 100, 30)
    except mjx.Unsupported:
        return None
    return jax.vmap(lambda state, control: physics.step(state, control, 1), -1, -1)


def judge(seed):
    """Return what became of a generated model, and its differences if there are any."""
    try:
        model = tight(load(draw(seed)))
    except ValueError:
        return "refused by MuJoCo", []
    if not model.nv or model.nv > 40:
        return "nothing moves", []
    is_ours = ours.unsupported(model) is None
    if is_ours:
        told = bool(ours.JaxPhysics(model).warnings)
        differences = compare(model, 3, seed, fields=dynamics.FIELDS)
    else:
        if mjx.differences(model):
            return "MJX's, whose differences are told, or refused", []
        told, engine = False, of_mjx(model)
        if engine is None:
            return "refused", []
        differences = compare(model, 2, seed, steps=(1,), engine=engine)
    whose = "ours" if is_ours else "MJX's"
    worst = max(x.excess for x in differences)
    if worst < 1e-4:
        return f"{whose}, the same", []
    return f"{whose}, different, " + ("told" if told else "SILENT"), differences


def main(first, last):
    """Compare generated models, and print those that differ without a reason."""
    logging.disable()
    count = collections.Counter()
    for seed in range(first, last):
        what, differences = judge(seed)
        count[what] += 1
        if differences:
            print(seed, what, *differences, flush=True)
        if seed % 20 == 19 or seed == last - 1:
            print(f"{first} to {seed}:", dict(count), flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
