"""The constraint solver against plain NumPy, and C MuJoCo on the host."""

import functools
import inspect
import os
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jax.sharding import AbstractDevice, AbstractMesh

import gasil_envs
from gasil_envs import locomotion, registry
from gasil_envs.physics import (
    batching,
    constraints,
    dynamics,
    host_threads,
    native,
    newton,
    newton_kernel,
    solver,
)
from gasil_envs.physics.interface import PhysicsState
from gasil_envs.physics.ours import ours_or_mjx
from gasil_jax import rollout
from gasil_jax.distributions import GAUSSIAN

# Edges of no tangent, of a pyramid in a plane and of one in space.
SIMPLE, FLAT, PYRAMID = (
    ((1,),),
    ((1, 1), (1, -1), (1, 0)),
    ((1, 1, 0), (1, -1, 0), (1, 0, 1), (1, 0, -1)),
)
AXES = ((1, 0, 0), (0, 1, 0), (0, 0, 1))


def solve(problem, iterations=4):
    """Solve one problem."""
    function = functools.partial(solver.solve_many, iterations, 4)
    return batching.batch_last(function, batching.in_tiles(function))(problem)


def test_a_batch_of_one_is_a_batch():
    """Under `vmap` one simulation is computed in a tile, and alone it is not."""
    marked = batching.batch_last(lambda x: x + 1.0, lambda x: x + 2.0)
    for function, batch, expected in (
        (marked, (), 1.0),
        (jax.vmap(marked), (1,), 2.0),
        (jax.vmap(jax.vmap(marked)), (1, 1), 2.0),
        (jax.vmap(jax.jit(jax.vmap(marked))), (2, 3), 2.0),
    ):
        result = function(jnp.zeros(batch))
        np.testing.assert_array_equal(result, np.full(batch, expected))
    tiled = jax.jit(batching.in_tiles(lambda x: 2.0 * x))
    np.testing.assert_array_equal(tiled(jnp.ones((3, 1))), np.full((3, 1), 2.0))


@pytest.mark.parametrize(
    ("name", "expected"), [("jax", True), ("mujoco", True), ("mjx", False)]
)
def test_only_our_physics_gets_the_option_that_keeps_loops(monkeypatch, name, expected):
    monkeypatch.setenv("XLA_FLAGS", "")
    registry.prepare(registry.Settings(physics=name), 1)
    assert ("disable_loop_unrolling" in os.environ["XLA_FLAGS"]) is expected
    monkeypatch.setenv("XLA_FLAGS", "")
    gasil_envs.make("inverted_pendulum", physics=name)
    assert ("disable_loop_unrolling" in os.environ["XLA_FLAGS"]) is expected


def test_host_calls_that_would_deadlock_are_refused(monkeypatch):
    monkeypatch.setattr(host_threads, "_NEEDS_THREADS", True)
    monkeypatch.setattr(jax, "local_device_count", lambda: 2)
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    monkeypatch.setenv("PJRT_NPROC", "2")
    with pytest.raises(RuntimeError, match="set PJRT_NPROC=4 before JAX starts"):
        host_threads.check()
    monkeypatch.setenv("PJRT_NPROC", "3")
    host_threads.check()


def problems(batch, size, groups, seed=0, *, pulling=False):
    """Random problems, and the same with every constraint as a row of a matrix."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(*batch, size, size))
    sign = rng.integers(-1, 2, size=(*batch, size)).astype(float)
    draw_reference = lambda *shape: rng.normal(size=(*batch, *shape)) - 1.0
    draw_weight = lambda *shape: 10.0 ** rng.uniform(-1.0, 2.0, size=(*batch, *shape))
    limits = newton.JointRows(sign, draw_reference(size), draw_weight(size))
    jacobian = [sign[..., None] * np.eye(size)]
    reference, weight, contacts = [limits.reference], [limits.weight], []
    for count, edges in groups:
        group = newton.ContactRows(
            basis=rng.normal(size=(*batch, count, len(edges[0]), size)),
            reference=draw_reference(count, len(edges)),
            weight=draw_weight(count, len(edges)),
            edges=edges,
        )
        contacts.append(group)
        rows = np.einsum("ea,...cav->...cev", np.array(edges, float), group.basis)
        jacobian.append(rows.reshape(*batch, -1, size))
        reference.append(group.reference.reshape(*batch, -1))
        weight.append(group.weight.reshape(*batch, -1))
    bound = np.zeros((*batch, sum(x.shape[-1] for x in reference)))
    joints = [limits]
    if pulling:
        # The last group's rows pull as well: every other one without bound.
        most = np.where(np.arange(contacts[-1].weight.shape[-2]) % 2, np.inf, 1.0)
        most = np.broadcast_to(most[:, None], contacts[-1].weight.shape)
        contacts[-1] = contacts[-1].replace(bound=most)
        bound[..., -most[0].size :] = most.reshape(*batch, -1)
        most = rng.uniform(size=(*batch, size))
        friction = newton.JointRows(
            np.ones_like(most), draw_reference(size), draw_weight(size), most
        )
        joints.append(friction)
        jacobian.append(np.broadcast_to(np.eye(size), (*batch, size, size)))
        reference.append(friction.reference)
        weight.append(friction.weight)
        bound = np.concatenate([bound, friction.bound], axis=-1)
    problem = newton.Problem(
        inertia=root @ np.swapaxes(root, -1, -2) + np.eye(size),
        force=5.0 * rng.normal(size=(*batch, size)),
        warmstart=rng.normal(size=(*batch, size)),
        joints=tuple(joints),
        contacts=tuple(contacts),
    )
    arrays = {
        "inertia": problem.inertia,
        "force": problem.force,
        "jacobian": np.concatenate(jacobian, axis=-2),
        "reference": np.concatenate(reference, axis=-1),
        "weight": np.concatenate(weight, axis=-1),
        "bound": bound,
    }
    return arrays, jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), problem)


def with_cones(problem):
    """Make the first group of contacts have elliptic cones."""
    group, *others = problem.contacts
    weight = group.weight[..., :1]
    cone = newton.Cone(
        jnp.broadcast_to(jnp.array([0.3, 0.7, 1, 2, 5])[:, None], weight.shape)
    )
    group = group.replace(weight=weight, bound=cone)
    return problem.replace(contacts=(group, *others))


def batch_last(problem):
    return jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), problem)


def plain_newton(inertia, force, jacobian, reference, weight, bound):
    """Newton's method in float64 with backtracking, until nothing changes.

    A row whose bound is 0 pushes alone.
    """
    most = np.where(bound > 0, bound, np.inf)
    distance = lambda q: jacobian @ q - reference
    pushes = lambda q: np.clip(-weight * distance(q), np.where(bound, -bound, 0), most)
    row_cost = lambda q: -pushes(q) * (distance(q) + 0.5 * pushes(q) / weight)
    cost = lambda q: 0.5 * q @ inertia @ q - force @ q + np.sum(row_cost(q))
    qacc = np.linalg.solve(inertia, force)
    for _ in range(100):
        gradient = inertia @ qacc - force - jacobian.T @ pushes(qacc)
        active = weight * (pushes(qacc) == -weight * distance(qacc))
        hessian = inertia + jacobian.T @ (active[:, None] * jacobian)
        direction, step = -np.linalg.solve(hessian, gradient), 1.0
        while cost(qacc + step * direction) > cost(qacc) and step > 1e-9:
            step /= 2
        qacc = qacc + step * direction
    return qacc, pushes(qacc)


# (12, 40) is above the size up to which sums are spelled out.
@pytest.mark.parametrize(
    ("size", "groups", "pulling"),
    [
        (5, [], False),
        (5, [(2, SIMPLE)], False),
        (9, [(10, FLAT)], False),
        (9, [(3, SIMPLE), (8, PYRAMID)], False),
        (12, [(40, PYRAMID)], False),
        (6, [(3, FLAT), (4, SIMPLE)], True),
    ],
)
def test_newton_against_plain_numpy(size, groups, pulling):
    arrays, problem = problems((20,), size, groups, pulling=pulling)
    solution = jax.jit(jax.vmap(lambda p: solve(p, 20)))(problem)
    edge_forces = [np.zeros((20, 0)), *solution.edge_forces]
    edge_forces = np.concatenate([x.reshape(20, -1) for x in edge_forces], axis=1)
    for i in range(20):
        qacc, force = plain_newton(**{name: x[i] for name, x in arrays.items()})
        np.testing.assert_allclose(solution.qacc[i], qacc, rtol=1e-3, atol=3e-4)
        scale = np.abs(force).max()
        # The rows of the limits, one for each degree of freedom, are the first.
        last = size + edge_forces.shape[1]
        np.testing.assert_allclose(edge_forces[i], force[size:last], atol=2e-3 * scale)
        # What the edges leave of this is the limits' and friction's.
        np.testing.assert_allclose(
            solution.constraint_force[i],
            arrays["jacobian"][i].T @ force,
            atol=4e-3 * scale,
        )


def test_a_search_that_would_come_and_go_ends():
    """Newton's steps go from one end of where friction gives to the other and back."""
    force = jnp.linspace(-24.0, -18.0, 61)[:, None]
    limit = newton.JointRows(*(jnp.full((61, 1), x) for x in (-1.0, 3.777, 19.0)))
    friction = (jnp.full((61, 1), x) for x in (1.0, 0.032, 9.0, 42.0))
    inertia, start = jnp.ones((61, 1, 1)), jnp.full((61, 1), -7.18)
    joints = limit, newton.JointRows(*friction)
    problem = newton.Problem(inertia, force, start, joints)
    qacc = jax.jit(jax.vmap(lambda p: solve(p, 20)))(problem).qacc
    pushes = 19.0 * jnp.maximum(3.777 + qacc, 0.0)
    held = force - pushes - jnp.clip(9.0 * (qacc - 0.032), -42.0, 42.0)
    np.testing.assert_allclose(qacc, held, atol=1e-4)


@pytest.mark.parametrize("batch", [(3, 4), (5, 32)])  # one tile, and more of them
def test_a_problem_alone_equals_itself_in_nested_batches(batch):
    _, problem = problems(batch, 6, [(2, SIMPLE), (4, FLAT)])
    nested = jax.jit(jax.vmap(jax.vmap(solve)))(problem)
    alone = jax.jit(solve)(jax.tree.map(lambda x: x[2, 1], problem))
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a[2, 1], b, rtol=5e-5, atol=5e-5),
        nested,
        alone,
    )


def test_elimination_against_numpy():
    arrays, problem = problems((7,), 23, [])
    problem = batch_last(problem)
    result = jax.jit(solver.eliminate)(problem.inertia, problem.force)
    expected = np.linalg.solve(arrays["inertia"], arrays["force"][..., None])[..., 0]
    np.testing.assert_allclose(result.T, expected, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("size", [1, 5, 16, 23, 32])
def test_the_gpu_s_elimination_solves_the_same(size):
    """Its operations are run by XLA; that it compiles for a GPU is another test."""
    _, problem = problems((20,), size, [])
    pair = jnp.moveaxis(problem.inertia, 0, -1), problem.force.T
    kernel = jax.jit(lambda *x: newton_kernel.eliminate_many(*x, interpret=True))
    expected = jax.jit(solver.eliminate)(*pair)
    np.testing.assert_allclose(kernel(*pair), expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("size", "groups", "pulling"),
    [
        (5, [], False),
        (5, [(2, SIMPLE), (5, FLAT)], False),
        (16, [(3, PYRAMID)], False),
        (23, [(9, PYRAMID)], False),
        (18, [(3, PYRAMID), (4, SIMPLE)], True),
        (9, [(5, AXES), (2, SIMPLE)], False),
    ],
)
def test_the_kernel_of_a_gpu_solves_the_same(size, groups, pulling):
    """Its operations are run by XLA; that it compiles for a GPU is another test."""
    _, problem = problems((40,), size, groups, pulling=pulling)
    has_cones = bool(groups) and groups[0][1] == AXES
    if has_cones:
        problem = with_cones(problem)
    contacts = []
    for group in problem.contacts:
        # The last contact is in play nowhere, and the one before it here and there.
        in_play = np.ones((40, len(group.weight[0]), 1))
        in_play[:, -1] = in_play[::2, -2] = 0.0
        contacts.append(group.replace(weight=group.weight * in_play))
    problem = batch_last(problem.replace(contacts=tuple(contacts)))
    most = (20, 20) if pulling or has_cones else (6, 4)
    expected = jax.jit(functools.partial(solver.solve_many, *most))(problem)
    kernel = functools.partial(newton_kernel.solve_many, *most, interpret=True)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4),
        jax.jit(kernel)(problem),
        expected,
    )


def test_a_gpu_takes_the_same_rows(monkeypatch):
    x, index = jnp.arange(12.0).reshape(6, 2), [4, 0, 0, 5]
    expected = batching.take(x, index)
    monkeypatch.setattr(batching, "on_cpu", lambda: False)
    np.testing.assert_array_equal(batching.take(x, index), expected)
    assert batching.take(x, []).shape == (0, 2)


@pytest.mark.parametrize(
    ("capability", "expected"), [("9.0", True), ("7.5", False), ("gfx90a", False)]
)
def test_old_and_other_gpus_have_no_triton(monkeypatch, capability, expected):
    device = SimpleNamespace(compute_capability=capability)
    monkeypatch.setattr(jax, "devices", lambda: [device])
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert batching.has_triton() is expected


@pytest.mark.parametrize("what", ["elimination", "pushing", "pulling", "cones"])
def test_the_kernels_of_a_gpu_can_be_lowered_for_one(what):
    groups = [(5, AXES)] if what == "cones" else [(3, SIMPLE), (8, PYRAMID)]
    _, problem = problems((20,), 9, groups, pulling=what == "pulling")
    problem = batch_last(with_cones(problem) if what == "cones" else problem)

    def solve(problem):
        if what != "elimination":
            return newton_kernel.solve_many(4, 4, problem)
        return newton_kernel.eliminate_many(problem.inertia, problem.force)

    fields = {"device_kind": "NVIDIA H100", "num_cores": None, "platform": "gpu"}
    names = inspect.signature(AbstractDevice).parameters  # Each jax has others.
    device = AbstractDevice(**{name: fields[name] for name in names})
    mesh = AbstractMesh((), (), abstract_device=device)
    with jax.sharding.use_abstract_mesh(mesh):
        lowered = jax.jit(solve).trace(problem).lower(lowering_platforms=("cuda",))
    assert "triton" in lowered.as_text()


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="of XLA's CPU backend")
def test_a_materialized_value_is_no_part_of_its_users_loops():
    def num_loops(hold):
        def many_uses(x):
            y = hold(jnp.sin(x) + x)
            return y[1:] * y[:-1] + y[:1]

        compiled = jax.jit(many_uses).lower(jnp.ones((8, 16))).compile()
        return compiled.as_text().count(" fusion(")

    assert num_loops(batching.materialize) > num_loops(lambda x: x) > 0


BALL = """<mujoco><option integrator="{integrator}" timestep="0.01"/><worldbody>
<geom type="plane" size="5 5 1"/>
<body pos="0 0 0.09"><freejoint/><geom type="sphere" size="0.1" mass="1"/></body>
</worldbody></mujoco>"""


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
def test_a_model_that_the_small_solver_cant_take_falls_back(integrator, caplog):
    model = mujoco.MjModel.from_xml_string(BALL.format(integrator=integrator))
    physics = ours_or_mjx(model)
    falls_back = "without others, with implicitfast" in caplog.text
    assert falls_back == (integrator == "implicitfast")
    data = mujoco.MjData(model)
    data.qvel[:] = [0.3, 0.0, -0.2, 1.0, 2.0, 3.0]
    state = PhysicsState(*map(jnp.float32, (data.qpos, data.qvel, 0 * data.qvel)))
    step = jax.jit(lambda state: physics.step(state, jnp.zeros(0), 10)[0])
    state = step(state)
    mujoco.mj_step(model, data, 10)
    np.testing.assert_allclose(state.qpos, data.qpos, atol=2e-5)
    np.testing.assert_allclose(state.qvel, data.qvel, atol=2e-4)


# A body that moves in a plane and slips on the ground.
SLIPPING = """<mujoco><option timestep="0.01"/><default><geom friction="0.3"/></default>
<worldbody><geom type="plane" size="5 5 1" {ground}/>
<body pos="0 0 0.09"><joint type="slide" axis="{along}"/>
<joint type="slide" axis="0 0 1"/><joint type="hinge" axis="{hinge}"/>
<geom size="0.1" mass="1" {geom}/>{more}</body>{fixed}</worldbody></mujoco>"""


@pytest.mark.parametrize(
    ("is_flat", "changes"),
    [
        (True, {}),
        (True, {"along": "0 1 0", "hinge": "-1 0 0"}),
        (True, {"geom": 'type="capsule" fromto="0.1 0 0 -0.1 0 0.02"'}),
        (True, {"ground": 'euler="0 20 0"'}),
        (True, {"more": '<geom pos="0 0.2 0" size="0.12" mass="1"/>'}),
        (True, {"fixed": '<geom pos="0.15 0 0.1" size="0.1"/>'}),
        # Here MuJoCo's tangents are neither in the plane nor across it.
        (False, {"along": "1 -1 0", "hinge": "1 1 0"}),
        (False, {"geom": 'type="capsule" fromto="0.1 0.1 0 -0.1 -0.1 0.02"'}),
        (False, {"ground": 'euler="20 0 0"'}),
        (False, {"fixed": '<geom pos="0.1 0.1 0.1" size="0.1"/>'}),
    ],
)
def test_motion_in_a_plane_against_mujoco(is_flat, changes):
    parts = {"ground": "", "along": "1 0 0", "hinge": "0 1 0", "geom": ""}
    parts |= {"more": "", "fixed": ""}
    model = mujoco.MjModel.from_xml_string(SLIPPING.format(**parts | changes))
    small = dynamics.make(model, iterations=20)
    for group in small.layout.groups:
        assert group.edges == (FLAT if is_flat else PYRAMID)
    data = mujoco.MjData(model)
    data.qvel[:] = [2.0, -0.5, -3.0]
    state = (data.qpos, data.qvel, np.zeros(3))
    state = PhysicsState(*(jnp.float32(x)[:, None] for x in state))
    step = jax.jit(lambda state: dynamics.step(small, state, jnp.zeros((0, 1)), 10)[0])
    state = step(state)
    mujoco.mj_step(model, data, 10)
    np.testing.assert_allclose(state.qpos[:, 0], data.qpos, atol=1e-4)
    np.testing.assert_allclose(state.qvel[:, 0], data.qvel, atol=1e-3)


@pytest.mark.parametrize("name", ["hopper", "walker2d", "halfcheetah", "ant"])
def test_tasks_in_a_plane_have_the_pyramid_of_a_plane(name):
    model = locomotion.Locomotion(name, physics="mujoco").model
    groups = [x for x in constraints.layout(model).groups if x.edges != SIMPLE]
    expected = PYRAMID if name == "ant" else FLAT
    assert [group.edges for group in groups] == [expected]


# Each kind of joint, rotated bodies, a spring, a medium, and contacts of a sphere and
# of capsules with the ground and with a capsule.
BODIES = """<mujoco><option timestep="0.01" density="800" viscosity="0.2"/><worldbody>
<geom type="plane" size="5 5 1"/>
<body pos="0 0 0.12"><freejoint/>
  <geom type="capsule" fromto="0 0 0 0.4 0.1 0" size="0.05"/>
  <body pos="0.4 0.1 0" euler="20 30 0">
    <joint type="hinge" axis="1 2 0" pos="0 0.02 0" range="-20 20" stiffness="3"
     damping="0.5" armature="0.1"/>
    <geom type="capsule" fromto="0 0 0 -0.3 0.1 0.1" size="0.04" friction="0.7"/>
    <body pos="-0.3 0.1 0.1"><joint type="slide" axis="0 0.6 0.8"/>
      <geom type="sphere" size="0.06"/></body>
  </body>
  <body pos="0.1 0.15 0.1"><joint type="hinge" axis="0 0 1"/>
    <geom type="capsule" fromto="0 0 0 0.25 0.05 0.05" size="0.05"/></body>
</body></worldbody></mujoco>"""


def test_accelerations_and_contact_forces_against_mujoco(monkeypatch):
    monkeypatch.setattr(constraints, "MOST_IN_PLAY", 4)
    model = mujoco.MjModel.from_xml_string(BODIES)
    rng, states = np.random.default_rng(0), []
    for _ in range(20):
        data = mujoco.MjData(model)
        data.qpos += 0.15 * rng.normal(size=model.nq)
        data.qvel[:] = rng.normal(size=model.nv)
        mujoco.mj_normalizeQuat(model, data.qpos)
        mujoco.mj_forward(model, data)
        mujoco.mj_rnePostConstraint(model, data)
        states.append(data)
    states.sort(key=lambda data: data.ncon)
    assert states[9].ncon <= 4 < states[-1].ncon
    kinds = {tuple(model.geom_type[x]) for y in states for x in y.contact.geom}
    assert len(kinds) == 4
    small = dynamics.make(model, dynamics.FIELDS, iterations=20)
    forward = jax.jit(lambda x: dynamics.forward(small, x, jnp.zeros((9, 10))))
    # Contacts in play have slots in the first ten states, and not in all of the others.
    for ten in states[:10], states[10:]:
        stack = lambda name, ten=ten: np.stack([getattr(x, name) for x in ten], -1)
        state = map(jnp.float32, map(stack, ("qpos", "qvel", "qvel")))
        result = forward(PhysicsState(*state))
        for name, value in {**result.fields, "qacc": result.qacc}.items():
            right = stack(name)
            atol = 2e-5 * max(1.0, np.abs(right).max())
            np.testing.assert_allclose(value, right, atol=atol, err_msg=name)


PENDULUM = """<mujoco><option timestep="0.01"/><worldbody><body>
<joint name="hinge" axis="0 1 0"/>
<geom type="capsule" size="0.05" fromto="0 0 0 0 0 1"/>
</body></worldbody>
<actuator><motor joint="hinge" gear="{gear}"/></actuator></mujoco>"""


@pytest.mark.parametrize("fields", [(), ("xpos", "cfrc_ext")])
def test_host_physics_in_nested_batches_and_a_scan_is_plain_mujoco(fields):
    model = mujoco.MjModel.from_xml_string(PENDULUM.format(gear=3))
    physics = native.MujocoPhysics(model, fields, threads=2)
    angle = jnp.linspace(-1.0, 1.0, 6).reshape(2, 3, 1)
    state = PhysicsState(angle, 0.5 * angle, 0.0 * angle)
    control = jnp.float32([0.7])

    def body(state, _):
        step = lambda one: physics.step(one, control, 4)
        return jax.vmap(jax.vmap(step))(state)

    end, seen = jax.jit(lambda state: jax.lax.scan(body, state, length=5))(state)
    assert {name: x.shape for name, x in seen.items()} == {
        name: (5, 2, 3, 2, getattr(mujoco.MjData(model), name).shape[1])
        for name in fields
    }
    for index in np.ndindex(2, 3):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = angle[index], 0.5 * angle[index]
        data.ctrl[:] = 0.7
        mujoco.mj_step(model, data, 20)
        np.testing.assert_allclose(end.qpos[index], data.qpos, rtol=1e-5)
        np.testing.assert_allclose(end.qvel[index], data.qvel, rtol=1e-5)
        if "xpos" in fields:
            np.testing.assert_allclose(seen["xpos"][4][index], data.xpos, atol=1e-6)


@pytest.mark.parametrize("fields", [(), ("xpos",)])
def test_a_simulation_that_fails_is_nan_and_harms_no_other(fields, capfd):
    model = mujoco.MjModel.from_xml_string(PENDULUM.format(gear=1))
    physics = native.MujocoPhysics(model, fields, threads=2)
    state = PhysicsState(*(jnp.zeros((4, 1)) for _ in range(3)))
    # MuJoCo warns, and puts it back at the start.
    state = state.replace(qvel=state.qvel.at[2].set(1e12))
    # What has failed before is not simulated again, which would print a warning.
    state = state.replace(qpos=state.qpos.at[1].set(jnp.nan))
    step = jax.jit(jax.vmap(lambda s: physics.step(s, jnp.ones(1), 4)))
    for _ in range(2):  # also where a simulation is used again
        following, given = step(state)
        np.testing.assert_array_equal(np.isnan(following.qpos[:, 0]), [0, 1, 1, 0])
        np.testing.assert_array_equal(following.qpos[0], following.qpos[3])
        for value in given.values():
            np.testing.assert_array_equal(np.isnan(value[:, 0, 0]), [0, 1, 1, 0])
    assert "QPOS" not in "".join(capfd.readouterr())


def test_a_failed_simulation_ends_its_episode_and_is_counted():
    env = gasil_envs.make("hopper", physics="mujoco")
    environments = rollout.init(env, jax.random.key(0), 4)
    physics = environments.state.pipeline_state.physics
    broken = physics.replace(qvel=physics.qvel.at[1].set(1e12))
    inner = environments.state.pipeline_state.replace(physics=broken)
    environments = environments.replace(
        state=environments.state.replace(pipeline_state=inner)
    )
    policy = lambda observation: (jnp.zeros((4, 3)), jnp.zeros(3))
    collect = jax.jit(
        lambda environments, key: rollout.collect(
            env,
            policy,
            environments,
            key,
            distribution=GAUSSIAN,
            num_steps=3,
            max_episode_steps=1000,
            gamma=jnp.float32(0.99),
        )
    )
    environments, batch = collect(environments, jax.random.key(1))
    expected = np.zeros((3, 4), bool)
    expected[0, 1] = True
    np.testing.assert_array_equal(batch.faulty, expected)
    np.testing.assert_array_equal(batch.terminated, expected)
    np.testing.assert_array_equal(environments.episode_length, [3, 2, 3, 3])
    assert np.all(np.isfinite(environments.state.obs))
