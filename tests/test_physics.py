"""The constraint solver against plain NumPy, and the fallback to MJX's."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from gasil_envs.physics import newton
from gasil_envs.physics.mjx import MjxPhysics


def problems(batch, size, rows, seed=0):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(*batch, size, size))
    arrays = {
        "inertia": root @ np.swapaxes(root, -1, -2) + np.eye(size),
        "force": 5.0 * rng.normal(size=(*batch, size)),
        "jacobian": rng.normal(size=(*batch, rows, size)),
        "reference": rng.normal(size=(*batch, rows)) - 1.0,
        "weight": 10.0 ** rng.uniform(-1.0, 2.0, size=(*batch, rows)),
        "warmstart": rng.normal(size=(*batch, size)),
    }
    return arrays, newton.Problem(
        **{name: jnp.asarray(x, jnp.float32) for name, x in arrays.items()}
    )


def plain_newton(inertia, force, jacobian, reference, weight):
    """Newton's method in float64 with backtracking, until nothing changes."""
    distance = lambda q: np.minimum(jacobian @ q - reference, 0.0)
    cost = lambda q: (
        0.5 * q @ inertia @ q - force @ q + 0.5 * np.sum(weight * distance(q) ** 2)
    )
    qacc = np.linalg.solve(inertia, force)
    for _ in range(100):
        gradient = inertia @ qacc - force + jacobian.T @ (weight * distance(qacc))
        active = weight * (distance(qacc) < 0)
        hessian = inertia + jacobian.T @ (active[:, None] * jacobian)
        direction, step = -np.linalg.solve(hessian, gradient), 1.0
        while cost(qacc + step * direction) > cost(qacc) and step > 1e-9:
            step /= 2
        qacc = qacc + step * direction
    return qacc, -weight * distance(qacc)


# Below and above the size up to which sums are spelled out.
@pytest.mark.parametrize(("size", "rows"), [(5, 2), (9, 40), (12, 90)])
def test_newton_against_plain_numpy(size, rows):
    arrays, problem = problems((20,), size, rows)
    del arrays["warmstart"]
    solution = jax.jit(jax.vmap(lambda p: newton.solve(p, 20)))(problem)
    for i in range(20):
        qacc, force = plain_newton(**{name: x[i] for name, x in arrays.items()})
        np.testing.assert_allclose(solution.qacc[i], qacc, rtol=1e-3, atol=2e-4)
        scale = np.abs(force).max()
        np.testing.assert_allclose(solution.row_force[i], force, atol=1e-3 * scale)
        np.testing.assert_allclose(
            solution.constraint_force[i],
            arrays["jacobian"][i].T @ force,
            atol=2e-3 * scale,
        )


def test_a_problem_alone_equals_itself_in_nested_batches():
    _, problem = problems((3, 4), 6, 10)
    nested = jax.jit(jax.vmap(jax.vmap(newton.solve)))(problem)
    alone = jax.jit(newton.solve)(jax.tree.map(lambda x: x[2, 1], problem))
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a[2, 1], b, rtol=2e-5, atol=2e-5),
        nested,
        alone,
    )


def test_linear_solve_against_numpy():
    arrays, problem = problems((7,), 23, 1)
    result = jax.jit(jax.vmap(newton.linear_solve))(problem.inertia, problem.force)
    expected = np.linalg.solve(arrays["inertia"], arrays["force"][..., None])[..., 0]
    np.testing.assert_allclose(result, expected, rtol=1e-3, atol=1e-3)


BALL = """<mujoco><option cone="{cone}" timestep="0.01"/><worldbody>
<geom type="plane" size="5 5 1"/>
<body pos="0 0 0.09"><freejoint/><geom type="sphere" size="0.1" mass="1"/></body>
</worldbody></mujoco>"""


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_a_model_that_the_small_solver_cant_take_falls_back(cone, caplog):
    model = mujoco.MjModel.from_xml_string(BALL.format(cone=cone))
    physics = MjxPhysics(model)
    assert ("its friction cones are elliptic" in caplog.text) == (cone == "elliptic")
    data = mujoco.MjData(model)
    data.qvel[:] = [0.3, 0.0, -0.2, 1.0, 2.0, 3.0]
    state = physics.init(
        jnp.asarray(data.qpos, jnp.float32), jnp.asarray(data.qvel, jnp.float32)
    )
    step = jax.jit(lambda state: physics.step(state, jnp.zeros(0), 10)[0])
    state = step(state)
    mujoco.mj_step(model, data, 10)
    np.testing.assert_allclose(state.qpos, data.qpos, atol=2e-5)
    np.testing.assert_allclose(state.qvel, data.qvel, atol=2e-4)
