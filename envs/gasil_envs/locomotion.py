"""Robots of MuJoCo as Brax environments, among them Gymnasium's locomotion tasks.

There is one class, `Locomotion`, for any `Task`, and a row in `TASKS` for each task of
Gymnasium (version 5). The models of these are Gymnasium's XML files; observation,
reward, termination, start and frame skip are those of ``gymnasium.envs.mujoco.*_v5``.
"""

import dataclasses
import importlib.util
import pathlib
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from gasil_envs.base import Env, State
from gasil_envs.physics import batching
from gasil_envs.physics.dynamics import FIELDS
from gasil_envs.physics.interface import Fields, Physics, PhysicsState
from gasil_envs.physics.mjx import MjxPhysics
from gasil_envs.physics.native import MujocoPhysics
from gasil_envs.physics.ours import ours_or_mjx

# MuJoCo would also write each of its warnings to MUJOCO_LOG.TXT in the user's folder.
_log = mujoco.MjLogConfig.get()
_log.logto_file = False
_log.set()

Range = tuple[float, float]
_EVERYTHING: Range = (-float("inf"), float("inf"))


@dataclasses.dataclass(frozen=True)
class Task:
    """The definition of one locomotion task, or of another task of a robot.

    Rewards are summed: ``forward_reward=0.0`` leaves out that of walking.

    Attributes:
      xml: path of the model's file, or the model itself, in MuJoCo's XML.
      frame_skip: number of physics steps in an environment step.
      gymnasium_id: name of the same task in Gymnasium, or None.
      forward_reward: weight of the forward velocity, 1 / (m/s).
      control_cost: weight of the squared norm of the action.
      healthy_reward: reward of each step that ends in a healthy state.
      healthy_z: open interval of the torso's height in metres, qpos[z_index].
      healthy_angle: open interval of the torso's angle in radians, qpos[2].
      healthy_state: open interval for all of qpos[2:] and qvel.
      z_index: index in qpos of the height.
      reset_noise: half width of the uniform noise on the initial state; also the
        standard deviation of normal velocity noise.
      normal_velocity_noise: whether the initial velocity's noise is normal.
      hidden_positions: number of leading entries of qpos that are not observed.
      max_velocity: largest absolute value of an observed velocity.
      fields: names of the arrays of ``mjData`` that the next functions use, of
        `physics.dynamics.FIELDS`.
      position: (model, fields) -> planar position (2,), whose change is the forward
        velocity; None for qpos[0:2].
      observe_more: fields -> the rest of the observation.
      observe: (state, fields) -> the whole observation; None for positions, velocities
        and what `observe_more` returns.
      contact_cost: contact forces, ``cfrc_ext`` (nbody, 6) -> cost.
      paid_beyond: forward position qpos[0] in metres up to which nothing is paid; None
        pays everywhere.
      reward: (state before, state after, fields, action) -> reward (), added to the
        others.
      healthy: (state, fields) -> bool (), whether an episode goes on.
      solver_iterations: largest number of Newton iterations in JAX; None for 100 of our
        physics, which stops where it has converged, mostly after 2 to 8, and 8 of MJX,
        or 30 if impratio is above 1. 4 are enough for most states of Gymnasium's tasks.
      ls_iterations: largest number of steps of each line search; None for 16 of our
        physics, or 4 if solver_iterations are given, and 8 of MJX.
      keyframe: name or number of the model's keyframe that episodes start from; None
        for the model's qpos0, at rest.
      start: random key -> qpos (nq,), qvel (nv,) of an episode's start; None for the
        model's own, with noise.
      episode_length: number of steps after which an episode is truncated.
    """

    xml: str | pathlib.Path
    frame_skip: int
    gymnasium_id: str | None = None
    forward_reward: float = 1.0
    control_cost: float = 1e-3
    healthy_reward: float = 0.0
    healthy_z: Range = _EVERYTHING
    healthy_angle: Range = _EVERYTHING
    healthy_state: Range = _EVERYTHING
    z_index: int = 1
    reset_noise: float = 5e-3
    normal_velocity_noise: bool = False
    hidden_positions: int = 1
    max_velocity: float = float("inf")
    fields: tuple[str, ...] = ()
    position: Callable[[mujoco.MjModel, Fields], jax.Array] | None = None
    observe_more: Callable[[Fields], jax.Array] | None = None
    observe: Callable[[PhysicsState, Fields], jax.Array] | None = None
    contact_cost: Callable[[jax.Array], jax.Array] | None = None
    paid_beyond: float | None = None
    reward: (
        Callable[[PhysicsState, PhysicsState, Fields, jax.Array], jax.Array] | None
    ) = None
    healthy: Callable[[PhysicsState, Fields], jax.Array] | None = None
    solver_iterations: int | None = None
    ls_iterations: int | None = None
    keyframe: str | int | None = None
    start: Callable[[jax.Array], tuple[jax.Array, jax.Array]] | None = None
    episode_length: int = 1000


# Found without importing it, which takes as long as all of our own modules.
_gymnasium = importlib.util.find_spec("gymnasium")
assert _gymnasium is not None and _gymnasium.origin is not None  # A dependency.
#: The folder of Gymnasium's models.
ASSETS = pathlib.Path(_gymnasium.origin).parent / "envs/mujoco/assets"


def _torso_position(model: mujoco.MjModel, fields: Fields) -> jax.Array:
    return fields["xpos"][1, :2]


def _mass_centre(model: mujoco.MjModel, fields: Fields) -> jax.Array:
    mass = jnp.asarray(model.body_mass, jnp.float32)
    return (mass @ fields["xipos"] / mass.sum())[:2]


def _clipped_contact_forces(fields: Fields) -> jax.Array:
    return jnp.clip(fields["cfrc_ext"], -1.0, 1.0)[1:].ravel()


def _body_observations(fields: Fields) -> jax.Array:
    return jnp.concatenate(
        [
            fields["cinert"][1:].ravel(),
            fields["cvel"][1:].ravel(),
            fields["qfrc_actuator"][6:],
            fields["cfrc_ext"][1:].ravel(),
        ]
    )


def _impact_cost(forces: jax.Array) -> jax.Array:
    """The cost of contact forces for both tasks of the humanoid."""
    return jnp.minimum(5e-7 * jnp.sum(forces**2), 10.0)


def _tip(fields: Fields) -> jax.Array:
    """The upper end of the second pole, x, y, z: its middle is its centre of mass."""
    return 2.0 * fields["xipos"][3] - fields["xpos"][3]


def _observe_poles(state: PhysicsState, fields: Fields) -> jax.Array:
    position, angles = state.qpos[:1], state.qpos[1:]
    seen = [position, jnp.sin(angles), jnp.cos(angles), jnp.clip(state.qvel, -10, 10)]
    return jnp.concatenate([*seen, jnp.clip(fields["qfrc_constraint"][:1], -10, 10)])


def _reward_of_poles(
    before: PhysicsState, after: PhysicsState, fields: Fields, action: jax.Array
) -> jax.Array:
    x, _, z = _tip(fields)
    _, lower, upper = after.qvel
    return -(0.01 * x**2 + (z - 2.0) ** 2) - (1e-3 * lower**2 + 5e-3 * upper**2)


def _to_target(fields: Fields) -> jax.Array:
    return fields["xpos"][3] - fields["xpos"][4]


def _observe_reacher(state: PhysicsState, fields: Fields) -> jax.Array:
    angles, target = state.qpos[:2], state.qpos[2:]
    seen = [jnp.cos(angles), jnp.sin(angles), target, state.qvel[:2]]
    return jnp.concatenate([*seen, _to_target(fields)[:2]])


def _start_of_reacher(key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The arm is nearly straight, and the target anywhere within 0.2 m."""
    angle_key, radius_key, direction_key, velocity_key = jax.random.split(key, 4)
    angles = jax.random.uniform(angle_key, (2,), minval=-0.1, maxval=0.1)
    radius = 0.2 * jnp.sqrt(jax.random.uniform(radius_key))
    direction = jax.random.uniform(direction_key, maxval=2.0 * jnp.pi)
    target = radius * jnp.stack([jnp.cos(direction), jnp.sin(direction)])
    speed = jax.random.uniform(velocity_key, (2,), minval=-5e-3, maxval=5e-3)
    return jnp.concatenate([angles, target]), jnp.append(speed, jnp.zeros(2))


#: The bodies of the pusher that its task is about.
_HAND, _OBJECT, _GOAL = 10, 11, 12


def _observe_pusher(state: PhysicsState, fields: Fields) -> jax.Array:
    bodies = [fields["xpos"][body] for body in (_HAND, _OBJECT, _GOAL)]
    return jnp.concatenate([state.qpos[:7], state.qvel[:7], *bodies])


def _reward_of_pusher(
    before: PhysicsState, after: PhysicsState, fields: Fields, action: jax.Array
) -> jax.Array:
    hand, thing, goal = (fields["xpos"][x] for x in (_HAND, _OBJECT, _GOAL))
    return -jnp.linalg.norm(thing - goal) - 0.5 * jnp.linalg.norm(thing - hand)


def _start_of_pusher(key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The object is to the left of the goal, more than 0.17 m from it."""
    position_key, velocity_key = jax.random.split(key)
    # 60% of all places are far enough away. The first such place of 32 is taken.
    low, high = jnp.array([-0.3, -0.2]), jnp.array([0.0, 0.2])
    places = jax.random.uniform(position_key, (32, 2), minval=low, maxval=high)
    place = places[jnp.argmax(jnp.linalg.norm(places, axis=1) > 0.17)]
    speed = jax.random.uniform(velocity_key, (7,), minval=-5e-3, maxval=5e-3)
    qpos = jnp.concatenate([jnp.zeros(7), place, jnp.zeros(2)])
    return qpos, jnp.append(speed, jnp.zeros(4))


#: Gymnasium's tasks by name.
TASKS: Mapping[str, Task] = {
    "hopper": Task(
        gymnasium_id="Hopper-v5",
        xml=ASSETS / "hopper.xml",
        frame_skip=4,
        solver_iterations=4,
        healthy_reward=1.0,
        healthy_z=(0.7, float("inf")),
        healthy_angle=(-0.2, 0.2),
        healthy_state=(-100.0, 100.0),
        max_velocity=10.0,
    ),
    "walker2d": Task(
        gymnasium_id="Walker2d-v5",
        xml=ASSETS / "walker2d_v5.xml",
        frame_skip=4,
        solver_iterations=4,
        healthy_reward=1.0,
        healthy_z=(0.8, 2.0),
        healthy_angle=(-1.0, 1.0),
        max_velocity=10.0,
    ),
    "halfcheetah": Task(
        gymnasium_id="HalfCheetah-v5",
        xml=ASSETS / "half_cheetah.xml",
        frame_skip=5,
        solver_iterations=4,
        control_cost=0.1,
        reset_noise=0.1,
        normal_velocity_noise=True,
    ),
    "swimmer": Task(
        gymnasium_id="Swimmer-v5",
        xml=ASSETS / "swimmer.xml",
        frame_skip=4,
        solver_iterations=4,
        control_cost=1e-4,
        reset_noise=0.1,
        hidden_positions=2,
    ),
    "ant": Task(
        gymnasium_id="Ant-v5",
        xml=ASSETS / "ant.xml",
        frame_skip=5,
        solver_iterations=4,
        control_cost=0.5,
        healthy_reward=1.0,
        healthy_z=(0.2, 1.0),
        z_index=2,
        reset_noise=0.1,
        normal_velocity_noise=True,
        hidden_positions=2,
        fields=("xpos", "cfrc_ext"),
        position=_torso_position,
        observe_more=_clipped_contact_forces,
        contact_cost=lambda f: 5e-4 * jnp.sum(jnp.clip(f, -1.0, 1.0) ** 2),
    ),
    "humanoid": Task(
        gymnasium_id="Humanoid-v5",
        xml=ASSETS / "humanoid.xml",
        frame_skip=5,
        solver_iterations=4,
        forward_reward=1.25,
        control_cost=0.1,
        healthy_reward=5.0,
        healthy_z=(1.0, 2.0),
        z_index=2,
        reset_noise=1e-2,
        hidden_positions=2,
        fields=("xipos", "cinert", "cvel", "qfrc_actuator", "cfrc_ext"),
        position=_mass_centre,
        observe_more=_body_observations,
        contact_cost=_impact_cost,
    ),
    "humanoidstandup": Task(
        gymnasium_id="HumanoidStandup-v5",
        xml=ASSETS / "humanoidstandup.xml",
        frame_skip=5,
        solver_iterations=8,
        forward_reward=0.0,
        control_cost=0.1,
        healthy_reward=1.0,
        reset_noise=1e-2,
        hidden_positions=2,
        fields=("cinert", "cvel", "qfrc_actuator", "cfrc_ext"),
        observe_more=_body_observations,
        contact_cost=_impact_cost,
        # The height over the duration of a time step.
        reward=lambda before, after, fields, action: after.qpos[2] / 0.003,
    ),
    "inverted_pendulum": Task(
        gymnasium_id="InvertedPendulum-v5",
        xml=ASSETS / "inverted_pendulum.xml",
        frame_skip=2,
        forward_reward=0.0,
        control_cost=0.0,
        healthy_reward=1.0,
        reset_noise=1e-2,
        hidden_positions=0,
        healthy=lambda state, fields: jnp.abs(state.qpos[1]) <= 0.2,
    ),
    "inverted_double_pendulum": Task(
        gymnasium_id="InvertedDoublePendulum-v5",
        xml=ASSETS / "inverted_double_pendulum.xml",
        frame_skip=5,
        forward_reward=0.0,
        control_cost=0.0,
        healthy_reward=10.0,
        reset_noise=0.1,
        normal_velocity_noise=True,
        fields=("xpos", "xipos", "qfrc_constraint"),
        observe=_observe_poles,
        reward=_reward_of_poles,
        healthy=lambda state, fields: _tip(fields)[2] > 1.0,
    ),
    "reacher": Task(
        gymnasium_id="Reacher-v5",
        xml=ASSETS / "reacher.xml",
        frame_skip=2,
        forward_reward=0.0,
        control_cost=1.0,
        fields=("xpos",),
        observe=_observe_reacher,
        reward=lambda before, after, fields, action: (
            -jnp.linalg.norm(_to_target(fields))
        ),
        start=_start_of_reacher,
        episode_length=50,
    ),
    "pusher": Task(
        gymnasium_id="Pusher-v5",
        xml=ASSETS / "pusher_v5.xml",
        frame_skip=5,
        forward_reward=0.0,
        control_cost=0.1,
        fields=("xpos",),
        observe=_observe_pusher,
        reward=_reward_of_pusher,
        start=_start_of_pusher,
        episode_length=100,
    ),
}


class LocomotionState(struct.PyTreeNode):
    """The physics state, and the planar position (2,) for computing the velocity."""

    physics: PhysicsState
    position: jax.Array


#: Physics engines by name: (model, fields, iterations, ls_iterations) -> `Physics`.
PHYSICS: Mapping[
    str, Callable[[mujoco.MjModel, tuple[str, ...], int | None, int | None], Physics]
] = {
    "jax": ours_or_mjx,
    "mjx": MjxPhysics,
    "mujoco": lambda model, fields, *_: MujocoPhysics(model, fields),
}

#: Integrators by name; "model" is the integrator that the model specifies.
INTEGRATORS: Mapping[str, mujoco.mjtIntegrator | None] = {
    "model": None,
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
}


def _load(xml: str | pathlib.Path) -> mujoco.MjModel:
    """Return the model in a file or an XML text; refuse it in one line."""
    is_text = str(xml).lstrip().startswith("<")
    load = mujoco.MjModel.from_xml_string if is_text else mujoco.MjModel.from_xml_path
    try:
        return load(str(xml))
    except ValueError as error:
        why = " ".join(str(error).split())
        raise ValueError(f"xml is no model of MuJoCo: {why}") from None


def _start(task: Task, model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Return qpos and qvel of a task's keyframe, or of its model's rest."""
    if task.keyframe is None:
        return model.qpos0, np.zeros(model.nv)
    try:
        keyframe = model.key(task.keyframe)
    except (KeyError, IndexError):
        names = ", ".join(model.key(i).name for i in range(model.nkey))
        raise ValueError(
            f"keyframe is {task.keyframe!r}: it must be one of "
            f"{names or 'none: the model has no keyframes'}"
        ) from None
    return keyframe.qpos, keyframe.qvel


def _with_unit_quaternions(model: mujoco.MjModel, qpos: jax.Array) -> jax.Array:
    """Return qpos with the quaternions of free joints and balls of length 1."""
    before = {int(mujoco.mjtJoint.mjJNT_FREE): 3, int(mujoco.mjtJoint.mjJNT_BALL): 0}
    for joint, kind in enumerate(model.jnt_type):
        if kind in before:
            first = model.jnt_qposadr[joint] + before[kind]
            quaternion = qpos[first : first + 4]
            quaternion = quaternion / jnp.linalg.norm(quaternion)
            qpos = qpos.at[first : first + 4].set(quaternion)
    return qpos


def _check(task: Task, model: mujoco.MjModel) -> None:
    """Raise `ValueError` if a task and its model do not fit or are not supported."""
    if not model.nu:
        raise ValueError("the model has no actuators: it must have one or more")
    entries = range(model.nq)
    indexed = f"an index of qpos, which has {model.nq} entries"
    skip = task.frame_skip
    low, high = model.actuator_ctrlrange.T
    length = task.episode_length
    positive = (None, *range(1, 1000))
    for field, allowed, holds in (
        ("frame_skip", "1 or more", isinstance(skip, int) and skip > 0),
        ("episode_length", "1 or more", isinstance(length, int) and length > 0),
        ("solver_iterations", "1 or more", task.solver_iterations in positive),
        ("ls_iterations", "1 or more", task.ls_iterations in positive),
        ("hidden_positions", indexed, task.hidden_positions in entries),
        ("z_index", indexed, task.z_index in entries or task.healthy_z == _EVERYTHING),
        (
            "healthy_angle",
            f"{_EVERYTHING}, as the model has no qpos[2]",
            model.nq > 2 or task.healthy_angle == _EVERYTHING,
        ),
        ("fields", f"a tuple of {', '.join(FIELDS)}", set(task.fields) <= {*FIELDS}),
    ):
        if not holds:
            raise ValueError(
                f"{field} is {getattr(task, field)!r}: it must be {allowed}"
            )
    if model.nactuator != model.nu:
        raise ValueError(
            "the model has actuators with several controls, such as pid: it must have "
            "one for each actuator"
        )
    # C keeps which bodies sleep, which is in no state of ours.
    if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
        raise ValueError("the model has the flag sleep: it must be disabled")
    if not (low < high).all():
        name = model.actuator(int(np.argmin(low < high))).name
        raise ValueError(
            f"actuator {name!r} of the model has no ctrlrange: it must have one, which "
            "is the range of its actions"
        )
    # A state holds positions and velocities only, so these would be lost.
    for size, what in (("na", "activations"), ("nhistory", "delays")):
        if getattr(model, size):
            raise ValueError(
                f"the model has actuators with {what}: its state must be positions and "
                "velocities"
            )


class Locomotion(Env):
    """A robot in one of the tasks in `TASKS`, or in a `Task` of your own.

    Actions are in the units of the model's actuators, as in Gymnasium. Physics limits
    them to `action_range`; the control cost is of the actions before this limit.

    Args:
      task: the task, or the name of one in `TASKS`.
      physics: "jax", our own in pure JAX, with "mjx" and a warning in its place for a
        model that it lacks a part of; "mjx", MuJoCo's MJX as shipped, which is slower;
        or "mujoco", in C on the host's cores.
      integrator: "model", the same as Gymnasium's, or "euler", which changes the task
        and needs a quarter of the evaluations if the model specifies Runge-Kutta.
    """

    def __init__(
        self, task: str | Task, *, physics: str = "jax", integrator: str = "model"
    ):
        for what, name, names in (
            ("task", task, TASKS),
            ("physics", physics, PHYSICS),
            ("integrator", integrator, INTEGRATORS),
        ):
            if name not in names and not isinstance(name, Task):
                raise ValueError(
                    f"{what} is {name!r}: it must be one of {', '.join(names)}"
                )
        batching.keep_loops(physics)
        self.task = task = task if isinstance(task, Task) else TASKS[task]
        self.model = _load(task.xml)
        _check(task, self.model)
        if INTEGRATORS[integrator] is not None:
            self.model.opt.integrator = INTEGRATORS[integrator]
        self.physics = PHYSICS[physics](
            self.model, task.fields, task.solver_iterations, task.ls_iterations
        )
        self.dt = self.model.opt.timestep * task.frame_skip
        # A NumPy array becomes a constant of the traced functions.
        qpos, qvel = _start(task, self.model)
        self._start, self._start_velocity = np.float32(qpos), np.float32(qvel)
        self.episode_length, self.action_size = task.episode_length, self.model.nu
        self.action_range = tuple(self.model.actuator_ctrlrange.T.astype(np.float32))
        self.backend = self.physics.name
        first = jax.eval_shape(self.reset, jax.random.key(0))
        self.observation_size = first.obs.shape[0]

    @property
    def ends_early(self) -> bool:
        """Whether an episode can end before its step limit."""
        bounds = (self.task.healthy_z, self.task.healthy_angle, self.task.healthy_state)
        return self.task.healthy is not None or any(x != _EVERYTHING for x in bounds)

    def reset(self, rng: jax.Array) -> State:
        """Start as the task says, or at rest with noise on positions and velocities."""
        if self.task.start is not None:
            qpos, qvel = self.task.start(rng)
            return self.state_at(_with_unit_quaternions(self.model, qpos), qvel)
        scale = self.task.reset_noise
        position_key, velocity_key = jax.random.split(rng)
        noise = jax.random.uniform(
            position_key, self._start.shape, jnp.float32, -scale, scale
        )
        qpos = _with_unit_quaternions(self.model, noise + self._start)
        shape = (self.model.nv,)
        if self.task.normal_velocity_noise:
            qvel = scale * jax.random.normal(velocity_key, shape, jnp.float32)
        else:
            qvel = jax.random.uniform(velocity_key, shape, jnp.float32, -scale, scale)
        if self._start_velocity.any():
            qvel = qvel + self._start_velocity
        return self.state_at(qpos, qvel)

    def state_at(self, qpos: jax.Array, qvel: jax.Array) -> State:
        """Return the state of an episode that starts at qpos (nq,) and qvel (nv,)."""
        physics = PhysicsState(qpos, qvel, jnp.zeros_like(qvel))
        fields = self.physics.kinematics(physics)
        zero = jnp.float32(0)
        return State(
            pipeline_state=LocomotionState(physics, self._position(physics, fields)),
            obs=self._observe(physics, fields),
            reward=zero,
            done=zero,
            metrics={"x_velocity": zero, "x_position": qpos[0]},
        )

    def step(self, state: State, action: jax.Array) -> State:
        task, before = self.task, state.pipeline_state
        physics, fields = self.physics.step(before.physics, action, task.frame_skip)
        position = self._position(physics, fields)
        x_velocity = (position[0] - before.position[0]) / self.dt

        healthy = self._is_healthy(physics, fields)
        reward = task.forward_reward * x_velocity + task.healthy_reward * healthy
        reward = reward - task.control_cost * jnp.sum(action**2)
        if task.contact_cost is not None:
            reward = reward - task.contact_cost(fields["cfrc_ext"])
        if task.reward is not None:
            reward = reward + task.reward(before.physics, physics, fields, action)
        if task.paid_beyond is not None:
            reward = jnp.where(physics.qpos[0] > task.paid_beyond, reward, 0.0)
        return state.replace(
            pipeline_state=LocomotionState(physics, position),
            obs=self._observe(physics, fields),
            reward=reward,
            done=1.0 - healthy,
            metrics={"x_velocity": x_velocity, "x_position": physics.qpos[0]},
        )

    def _position(self, physics: PhysicsState, fields: Fields) -> jax.Array:
        if self.task.position is None:
            return physics.qpos[:2]
        return self.task.position(self.model, fields)

    def _is_healthy(self, physics: PhysicsState, fields: Fields) -> jax.Array:
        task, qpos = self.task, physics.qpos

        def within(x: jax.Array, bounds: Any) -> jax.Array:
            return jnp.all((bounds[0] < x) & (x < bounds[1]))

        # A small robot may have no such entry, nor bounds of it.
        healthy = within(qpos[task.z_index : task.z_index + 1], task.healthy_z)
        healthy &= within(qpos[2:3], task.healthy_angle)
        healthy &= within(jnp.concatenate([qpos[2:], physics.qvel]), task.healthy_state)
        # Without bounds this is still false for NaN and infinity.
        if task.healthy is not None:
            healthy &= task.healthy(physics, fields)
        return healthy.astype(jnp.float32)

    def _observe(self, physics: PhysicsState, fields: Fields) -> jax.Array:
        task = self.task
        if task.observe is not None:
            return task.observe(physics, fields)
        parts = [
            physics.qpos[task.hidden_positions :],
            jnp.clip(physics.qvel, -task.max_velocity, task.max_velocity),
        ]
        if task.observe_more is not None:
            parts.append(task.observe_more(fields))
        return jnp.concatenate(parts)
