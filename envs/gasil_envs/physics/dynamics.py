"""One time step of MuJoCo's dynamics, many states at once.

The stages and integrators are those of C MuJoCo (``engine_forward.c``). Smooth dynamics
are in `tree`, contacts in `collision`, constraint rows in `constraints`, and every
linear system is solved in `solver`. Every array has the batch as its last axis.

Shape letters: N bodies, V degrees of freedom, B batch.
"""

import copy
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from gasil_envs.physics import actuators, constraints, newton, solver, tendons, tree
from gasil_envs.physics.batching import materialize, on_cpu, total
from gasil_envs.physics.interface import Fields, PhysicsState

#: The arrays of ``mjData`` that `step` can return.
FIELDS = (
    *("xpos", "xipos", "cinert", "cvel"),
    *("qfrc_actuator", "qfrc_constraint", "cfrc_ext"),
)


class Dynamics(NamedTuple):
    """A model, and the parts of its dynamics that do not depend on the state."""

    model: mujoco.MjModel
    layout: constraints.Layout
    actuators: actuators.Actuators
    tendons: tendons.Tendons  # The fixed tendons.
    #: Largest numbers of iterations of the solver and of a line search.
    iterations: tuple[int, int]
    presses: bool  # Whether float32 may lose digits of the constraints' forces.
    fields: tuple[str, ...]  # Names of the fields to return, of `FIELDS`.


# From this stiffness of contacts on, and from this depth at the start in sizes of a
# body, float32 loses digits of the constraints' forces.
_STIFF, _DEEP = 20.0, 0.01
#: Fields that are about the centre of mass of each body's own tree, with its base.
_OF_ONE_TREE = ("cinert", "cvel", "cfrc_ext")
_FLAGS = mujoco.mjtDisableBit
_EULER, _RK4, _IMPLICITFAST = (
    getattr(mujoco.mjtIntegrator, f"mjINT_{x}")
    for x in ("EULER", "RK4", "IMPLICITFAST")
)


def _enabled(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return the model without what its flags disable, but for contacts."""
    off = model.opt.disableflags
    if off & _FLAGS.mjDSBL_CONSTRAINT:
        off |= _FLAGS.mjDSBL_EQUALITY | _FLAGS.mjDSBL_FRICTIONLOSS
        off |= _FLAGS.mjDSBL_LIMIT
    names = {
        _FLAGS.mjDSBL_EQUALITY: ("eq_active0",),
        _FLAGS.mjDSBL_FRICTIONLOSS: ("dof_frictionloss", "tendon_frictionloss"),
        _FLAGS.mjDSBL_LIMIT: ("jnt_limited", "tendon_limited"),
        _FLAGS.mjDSBL_SPRING: ("jnt_stiffness", "tendon_stiffness"),
        _FLAGS.mjDSBL_DAMPER: ("dof_damping", "tendon_damping"),
        _FLAGS.mjDSBL_CLAMPCTRL: ("actuator_ctrllimited",),
        _FLAGS.mjDSBL_ACTUATION: ("actuator_gainprm", "actuator_biasprm"),
    }
    disabled = [name for flag, x in names.items() if off & flag for name in x]
    passive = _FLAGS.mjDSBL_SPRING | _FLAGS.mjDSBL_DAMPER
    if off & passive == passive:
        disabled.append("body_gravcomp")
    if disabled or off & _FLAGS.mjDSBL_GRAVITY:
        model = copy.copy(model)
        for name in disabled:
            getattr(model, name)[:] = 0
        if "body_gravcomp" in disabled:
            model.opt.density = model.opt.viscosity = 0.0
        if off & _FLAGS.mjDSBL_GRAVITY:
            model.opt.gravity[:] = 0.0
    return model


def unsupported(model: mujoco.MjModel) -> str | None:
    """Return why `make` does not support this model; None if it does."""
    model = _enabled(model)
    if model.opt.integrator not in (_EULER, _RK4, _IMPLICITFAST):
        return "its integrator is neither Euler, RK4 nor implicitfast"
    medium = model.opt.density > 0 or model.opt.viscosity > 0
    if model.opt.integrator == _IMPLICITFAST:
        if medium or tree.has_lone_bodies(model):
            return "it has a medium or a free body without others, with implicitfast"
    return (
        actuators.unsupported(model)
        or tendons.unsupported(model)
        or tree.unsupported(model)
        or constraints.unsupported(model)
    )


def make(
    model: mujoco.MjModel,
    fields: Sequence[str] = (),
    iterations: int = 4,
    ls_iterations: int = 4,
) -> Dynamics:
    """Compute what does not depend on the state, for a supported model."""
    model = _enabled(model)
    layout = constraints.layout(model)
    return Dynamics(
        model,
        layout,
        actuators.make(model),
        tendons.fixed(model),
        (iterations, ls_iterations),
        layout.stiffness > _STIFF or constraints.collision.depth(model) > _DEEP,
        tuple(fields),
    )


class _Evaluation(NamedTuple):
    """The result of one evaluation of the dynamics."""

    inertia: jax.Array  # (V, V, B).
    force: jax.Array  # (V, B), all forces.
    qacc: jax.Array  # (V, B).
    fields: Fields


def _fields(names: Sequence[str], at: tree.Kinematics, *others: jax.Array) -> Fields:
    """Return the named fields; `others` are those from "cvel" on, in order."""
    every = zip(FIELDS, (at.xpos, at.xipos, at.cinert, *others), strict=True)
    return {name: x for name, x in every if name in names}


def _place(
    model: mujoco.MjModel, names: Sequence[str], qpos: jax.Array
) -> tree.Kinematics:
    # What is heavy and does not move costs digits, so it counts only if it is seen.
    fixed = (model.body_treeid < 0) & (model.body_mass > 0)
    seen = bool({*names} & {*_OF_ONE_TREE})
    return tree.kinematics(model, qpos, with_bases=seen and bool(fixed.any()))


def kinematics(
    model: mujoco.MjModel, names: Sequence[str], state: PhysicsState
) -> Fields:
    """Return the named fields at `state`, with all forces 0."""
    size = state.qpos.shape[-1]
    at = _place(model, names, state.qpos)
    cvel = tree.velocity(model, at.cdof, state.qvel)
    no_force = jnp.zeros((model.nv, size), jnp.float32)
    of_bodies = jnp.zeros((model.nbody, 6, size), jnp.float32)
    return _fields(names, at, cvel, no_force, no_force, of_bodies)


def forward(
    dynamics: Dynamics, state: PhysicsState, actuation: jax.Array
) -> _Evaluation:
    """Compute accelerations and fields.

    `actuation` are the forces (V, B) of motors, or the controls (nu, B) of others.
    """
    model, (qpos, qvel) = dynamics.model, (state.qpos, state.qvel)
    at = _place(model, dynamics.fields, qpos)
    smooth = tree.smooth(model, at, qpos, qvel)
    if not dynamics.actuators.are_motors:
        actuation = actuators.forces(dynamics.actuators, actuation, qpos, qvel)
    force = smooth.force + actuation
    of_tendons = tendons.forces(model, dynamics.tendons, qpos, qvel)
    force = materialize(force if of_tendons is None else force + of_tendons)
    lines = constraints.collision.segments(model, at)
    groups = dynamics.layout.groups
    contacts = [
        constraints.Contacts(
            materialize(constraints.collision.touch(model, x.pairs, lines)), x.constants
        )
        for x in groups
    ]
    joints = [constraints.limit_rows(dynamics.layout.limits, qpos, qvel)]
    if dynamics.layout.friction is not None:
        joints.append(constraints.friction_rows(dynamics.layout.friction, qvel))
    others = [
        constraints.other_rows(*x, at, qpos=qpos, qvel=qvel)
        for x in dynamics.layout.others
    ]
    trees = tree.trees(model)

    def constrain(contacts: Sequence[constraints.Contacts], for_speed: bool) -> Any:
        rows = [
            constraints.contact_rows(group.edges, x, at, trees=trees, qvel=qvel)
            for group, x in zip(groups, contacts, strict=True)
        ]
        problem = newton.Problem(
            smooth.inertia, force, state.qacc_warmstart, tuple(joints), (*rows, *others)
        )
        solution = solver.solve_many(*dynamics.iterations, problem, for_speed=for_speed)
        of_bodies = jnp.zeros((model.nbody, 6, qpos.shape[-1]), jnp.float32)
        if "cfrc_ext" in dynamics.fields:
            forces = solution.edge_forces[: len(groups)]
            for group, x, edge in zip(groups, contacts, forces, strict=True):
                of_bodies = of_bodies + constraints.body_forces(
                    group.edges, x, at.com, edge_forces=edge
                )
        return solution.qacc, solution.constraint_force, of_bodies

    qacc, constraint_force, of_bodies = _with_contacts_in_play(constrain, contacts)
    if dynamics.presses:
        # The rows' forces are differences of large numbers; their sum need not be.
        held = total(smooth.inertia * qacc, 1)
        constraint_force = held - force
    of_forces = actuation, constraint_force, of_bodies
    fields = _fields(dynamics.fields, at, smooth.cvel, *of_forces)
    return _Evaluation(smooth.inertia, force + constraint_force, qacc, fields)


# On a GPU a branch waits for the host, which pays from this many possible contacts on.
_FEWEST_WORTH_A_BRANCH = 20


def _with_contacts_in_play(
    function: Callable[[Sequence[constraints.Contacts], bool], Any],
    contacts: Sequence[constraints.Contacts],
) -> Any:
    """Call a function with only the contacts that are in play, and for speed.

    If one of the states has more in a group than there are slots, the function gets all
    contacts of all. This is rare, so that program is compiled for size.
    """
    count = [x.touch.distance.shape[0] for x in contacts]
    most = max(count, default=0)
    if most <= constraints.MOST_IN_PLAY or not (
        on_cpu() or most >= _FEWEST_WORTH_A_BRANCH
    ):
        return function(contacts, True)
    in_play = jnp.stack([constraints.num_in_play(x) for x in contacts])
    return jax.lax.cond(
        jnp.all(in_play <= constraints.MOST_IN_PLAY),
        lambda: function([constraints.gather(x) for x in contacts], True),
        lambda: function(contacts, False),
    )


def step(
    dynamics: Dynamics, state: PhysicsState, control: jax.Array, frame_skip: int
) -> tuple[PhysicsState, Fields]:
    """Advance `frame_skip` time steps; the fields are of the last evaluation."""
    own = dynamics.actuators
    control = actuation = jnp.clip(control, *own.control_range)
    if own.are_motors:
        motor = (own.transmission.of_qvel.T * own.gain[:, 0]).astype(np.float32)
        moved = total(jnp.asarray(motor)[..., None] * control, 1)
        actuation = moved if dynamics.model.nu else jnp.zeros_like(state.qvel)
    is_rk4 = dynamics.model.opt.integrator == _RK4
    integrate = _runge_kutta if is_rk4 else _euler
    one = functools.partial(integrate, dynamics, actuation)
    carry = (state, kinematics(dynamics.model, dynamics.fields, state))
    return jax.lax.scan(lambda x, _: (one(*x), None), carry, length=frame_skip)[0]


def _integrate_positions(
    model: mujoco.MjModel, qpos: jax.Array, qvel: jax.Array
) -> jax.Array:
    """qpos (nq, B) after one time step at qvel (V, B)."""
    dt = model.opt.timestep
    parts, q, v = [], 0, 0
    for kind in model.jnt_type:
        if kind == tree.FREE:
            parts.append(qpos[q : q + 3] + dt * qvel[v : v + 3])
            parts.append(_rotate(qpos[q + 3 : q + 7], qvel[v + 3 : v + 6], dt))
            q, v = q + 7, v + 6
        elif kind == tree.BALL:
            parts.append(_rotate(qpos[q : q + 4], qvel[v : v + 3], dt))
            q, v = q + 4, v + 3
        else:
            parts.append(qpos[q : q + 1] + dt * qvel[v : v + 1])
            q, v = q + 1, v + 1
    return jnp.concatenate(parts)


def _rotate(quaternion: jax.Array, velocity: jax.Array, dt: float) -> jax.Array:
    """Unit quaternions (4, B) after turning with `velocity` (3, B) rad/s for `dt`."""

    def norm(x: jax.Array) -> jax.Array:
        return jnp.sqrt(total(x**2))

    speed = norm(velocity)
    half = 0.5 * dt * speed
    scale = jnp.where(speed > 1e-10, jnp.sin(half) / jnp.maximum(speed, 1e-10), 0.0)
    w, x, y, z = quaternion
    a, (b, c, d) = jnp.cos(half), scale * velocity
    turned = jnp.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ]
    )
    return turned / norm(turned)


def _euler(
    dynamics: Dynamics, actuation: jax.Array, state: PhysicsState, fields: Fields
) -> tuple[PhysicsState, Fields]:
    """Semi-implicit Euler, with damping taken implicitly.

    That is the joints' damping, and with implicitfast also that of tendons and servos.
    """
    model, own = dynamics.model, dynamics.actuators
    dt = model.opt.timestep
    now = forward(dynamics, state, actuation)
    qacc = now.qacc
    implicitfast = model.opt.integrator == _IMPLICITFAST
    if implicitfast or not model.opt.disableflags & _FLAGS.mjDSBL_EULERDAMP:
        constant = np.diag(model.dof_damping)
        if implicitfast:
            of_qvel = dynamics.tendons.of_qvel
            constant = constant + of_qvel.T @ (model.tendon_damping[:, None] * of_qvel)
        damping: Any = (dt * constant).astype(np.float32)[..., None]
        of_servos = implicitfast and not own.are_motors
        if of_servos:
            damping = damping + dt * actuators.damping(
                own, actuation, state.qpos, qvel=state.qvel
            )
        if dynamics.presses and (of_servos or constant.any()):
            # Large forces that balance each other are not added again.
            lost = total(damping * qacc, 1)
            qacc = qacc - solver.eliminate(now.inertia + damping, lost)
        elif of_servos or constant.any():
            qacc = solver.eliminate(now.inertia + damping, now.force)
    qvel = state.qvel + dt * qacc
    qpos = _integrate_positions(model, state.qpos, qvel)
    return PhysicsState(qpos, qvel, now.qacc), now.fields


def _runge_kutta(
    dynamics: Dynamics, actuation: jax.Array, state: PhysicsState, fields: Fields
) -> tuple[PhysicsState, Fields]:
    """Classical Runge-Kutta of order 4.

    The first evaluation, at the state itself, is a stage of the loop too, so that
    `forward`, the largest part of the program, is compiled only once.
    """
    model = dynamics.model
    dt = model.opt.timestep
    qpos, qvel = state.qpos, state.qvel

    def stage(carry: Any, coefficients: Any) -> Any:
        state, velocity_sum, acceleration_sum, _ = carry
        ahead, weight = coefficients
        # Both are replaced at once: positions use the velocity of the previous stage.
        position = _integrate_positions(model, qpos, ahead * state.qvel)
        state = state.replace(
            qpos=position, qvel=qvel + dt * ahead * state.qacc_warmstart
        )
        now = forward(dynamics, state, actuation)
        state = state.replace(qacc_warmstart=now.qacc)
        velocity_sum = velocity_sum + weight * state.qvel
        acceleration_sum = acceleration_sum + weight * now.qacc
        return (state, velocity_sum, acceleration_sum, now.fields), None

    stages = np.array(
        [[0.0, 1 / 6], [0.5, 1 / 3], [0.5, 1 / 3], [1.0, 1 / 6]], np.float32
    )
    zero = jnp.zeros_like(qvel)
    carry = (state, zero, zero, fields)
    (state, velocity, acceleration, fields), _ = jax.lax.scan(stage, carry, stages)
    qpos = _integrate_positions(model, qpos, velocity)
    return PhysicsState(qpos, qvel + dt * acceleration, state.qacc_warmstart), fields
