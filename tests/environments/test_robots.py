"""Robots that are none of the package's tasks, on the fast physics."""

import dataclasses
import pathlib
import re

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from refusals import rows

from gasil_envs import Locomotion, Task
from gasil_envs.locomotion import ASSETS
from gasil_envs.physics.interface import PhysicsState

TEXT = (pathlib.Path(__file__).parents[2] / "docs" / "extending.md").read_text()
QUADRUPED = re.search(r'MODEL = """\n(.*?)"""', TEXT, re.DOTALL).group(1)

ARM = """<mujoco>{top}<worldbody>{world}<body name="arm">
<joint name="hinge" axis="0 1 0" {joint}/><geom type="capsule" size="0.05" {geom}
fromto="0 0 0 0 0 1"/>{body}</body></worldbody>
<actuator><motor joint="hinge" {motor}/></actuator></mujoco>"""


CYLINDER = '<geom type="cylinder" size="0.1 0.1"/>'


def arm(motor='ctrlrange="-1 1"', **parts):
    names = ("top", "world", "joint", "geom", "body")
    return ARM.format(motor=motor, **dict.fromkeys(names, "") | parts)


def transitions(model, frame_skip, count):
    """States of C MuJoCo under random actions, and those after one step."""
    rng, data, steps = np.random.default_rng(0), mujoco.MjData(model), []
    for i in range(3 * count):
        if i % 50 == 0:
            mujoco.mj_resetData(model, data)
            data.qpos += rng.uniform(-0.05, 0.05, model.nq)
            data.qvel += rng.uniform(-0.05, 0.05, model.nv)
            mujoco.mj_normalizeQuat(model, data.qpos)
        before = data.qpos.copy(), data.qvel.copy(), data.qacc_warmstart.copy()
        data.ctrl[:] = rng.uniform(*model.actuator_ctrlrange.T)
        action = data.ctrl.copy()
        mujoco.mj_step(model, data, frame_skip)
        steps.append((*before, action, np.append(data.qpos, data.qvel), data.ncon))
    return [np.stack(x) for x in zip(*steps[::3])]


# Trees: one, one with contacts, two. The arm of the last meets a wall and, in the
# plane of all motion, its target.
@pytest.mark.parametrize(
    ("xml", "most"),
    [
        (ASSETS / "inverted_double_pendulum.xml", 6e-7),
        (QUADRUPED, 1e-6),
        (ASSETS / "reacher.xml", 6e-7),
    ],
)
def test_one_step_equals_mujocos(xml, most, caplog):
    task = Task(xml=xml, frame_skip=5)
    env = Locomotion(task)
    assert not caplog.text  # It is the fast physics.
    is_text = xml is QUADRUPED
    load = mujoco.MjModel.from_xml_string if is_text else mujoco.MjModel.from_xml_path
    *before, action, after, contacts = transitions(load(str(xml)), 5, 200)
    state = PhysicsState(*(jnp.float32(x) for x in before))
    step = jax.jit(jax.vmap(lambda x, a: env.physics.step(x, a, 5)[0]))
    state = step(state, jnp.float32(action))
    ours = np.concatenate([state.qpos, state.qvel], axis=1)
    error = (np.abs(ours - after) / (1.0 + np.abs(after))).max(axis=1)
    print(f"{contacts.mean():.1f} contacts, errors {np.quantile(error, [0.5, 0.9, 1])}")
    assert np.median(error) < most
    assert error.max() < 1e-4  # 0.2 with half as many iterations of the solver
    if is_text:
        assert contacts.max() >= 2


def test_a_task_s_own_functions_make_its_episodes():
    position = jnp.float32([0.1, 0.2, 0.05, -0.1])
    task = Task(
        xml=ASSETS / "reacher.xml",
        frame_skip=2,
        forward_reward=0.0,
        control_cost=0.0,
        hidden_positions=0,
        fields=("xpos",),
        observe_more=lambda fields: fields["xpos"][3] - fields["xpos"][4],
        reward=lambda before, after, fields, action: (
            after.qpos[0] - before.qpos[0] + action[0] + fields["xpos"][4, 0]
        ),
        healthy=lambda physics, fields: physics.qpos[0] < 0.15,
        start=lambda key: (position, jnp.zeros(4)),
    )
    env = Locomotion(task)
    assert env.ends_early and env.observation_size == 11
    state = jax.jit(env.reset)(jax.random.key(0))
    np.testing.assert_allclose(state.obs[:4], position)
    step = jax.jit(env.step)
    for action, done in ((-0.1, 0), (1.0, 0), (1.0, 1)):
        before = state.obs[0]
        state = step(state, jnp.float32([action, 0.0]))
        # The goal is where it started, in the last coordinate that it has.
        expected = state.obs[0] - before + action + position[2]
        np.testing.assert_allclose(state.reward, expected, atol=1e-5)
        assert state.done == done or state.obs[0] < 0.15


@pytest.mark.parametrize(
    ("parts", "what"),
    [
        ({"world": '<geom type="box" size="1 1 1"/>'}, "contacts of capsule and box"),
        (
            {
                "top": '<option integrator="implicitfast"/>',
                "world": '<body pos="5 0 0"><freejoint/><geom size="0.1"/></body>',
            },
            "a medium or a free body without others, with implicitfast",
        ),
    ],
)
def test_what_the_fast_physics_lacks_is_noted(parts, what, caplog):
    env = Locomotion(Task(xml=arm(**parts), frame_skip=1, hidden_positions=0))
    assert env.backend == "mjx"
    assert "physics 'mjx' is used, some ten times slower than 'jax'" in caplog.text
    assert what in caplog.text and "\n" not in caplog.records[0].getMessage()


DC = 'ctrlrange="-1 1"/><dcmotor joint="hinge" motorconst="1" resistance="1"'
FILTER = '<general dyntype="filter" dynprm="1" name="a"'
#: Parts of the arm, and what MJX lacks.
LACKING = """
joint='stiffness="1 2 3"' | nonlinear springs
joint='damping="1 2 3"' | nonlinear damping
motor='ctrlrange="-1 1" damping="3"' | actuators with damping
motor='ctrlrange="-1 1" armature="3"' | actuators with armature
geom='fluidshape="ellipsoid"', top='<option density="9"/>' | fluidshape
top='<option integrator="discrete"/>' | integrator
top='<option><flag override="enable"/></option>' | the flag override
world='<geom type="box" size="1 1 1"/>', body=CYLINDER | CYLINDER
motor=f'{DC} ctrlrange="-1 1"' | DCMOTOR
top='<option noslip_iterations="3"/>' | noslip_iterations
top='<option integrator="implicit"/>' | IMPLICIT
"""


@pytest.mark.parametrize(("parts", "what"), rows(LACKING))
def test_what_mjx_lacks_is_refused_and_c_mujoco_takes_it(parts, what):
    task = Task(xml=eval(f"arm({parts})"), frame_skip=1, hidden_positions=0)

    def one_step(physics):
        env = Locomotion(task, physics=physics)
        state = jax.eval_shape(env.reset, jax.random.key(0))
        jax.eval_shape(env.step, state, jnp.zeros(1))

    for physics in ("jax", "mjx"):
        message = f"physics '{physics}' does not support this model: .*{what}"
        with pytest.raises(ValueError, match=message) as told:
            one_step(physics)
        assert "\n" not in str(told.value)
    one_step("mujoco")


SENSORS = """<sensor><jointpos joint="hinge"/><touch site="s"/><e_kinetic/>
<clock/><subtreecom body="arm"/><contact body1="arm" data="found"/></sensor>"""


@pytest.mark.parametrize("flag", ["energy", "fwdinv"])
@pytest.mark.parametrize("physics", ["jax", "mjx", "mujoco"])
def test_sensors_and_flags_that_move_nothing_are_taken(physics, flag):
    top = f'<option><flag {flag}="enable"/></option>{SENSORS}'
    xml = arm(top=top, body='<site name="s"/>')
    env = Locomotion(Task(xml=xml, frame_skip=1, hidden_positions=0), physics=physics)
    assert env.backend == physics


KEYS = """<keyframe><key name="up" qpos="0.5" qvel="2"/><key qpos="1"/></keyframe>"""


def test_an_episode_starts_from_a_keyframe():
    for keyframe, expected in ((None, [0, 0]), ("up", [0.5, 2]), (1, [1, 0])):
        still = {"hidden_positions": 0, "reset_noise": 0.0}
        task = Task(xml=arm(top=KEYS), frame_skip=1, keyframe=keyframe, **still)
        start = Locomotion(task).reset(jax.random.key(0))
        np.testing.assert_allclose(start.obs, expected)
    with pytest.raises(ValueError, match="keyframe is 'down': it must be one of up, "):
        Locomotion(dataclasses.replace(task, keyframe="down"))


def test_a_ball_starts_with_a_quaternion_of_length_1():
    ball = '<body pos="0 0 1"><joint type="ball"/><geom size="0.1"/></body>'
    task = Task(xml=arm(body=ball), frame_skip=1, hidden_positions=0, reset_noise=0.3)
    start = Locomotion(task).reset(jax.random.key(0))
    assert abs(start.obs[0]) > 0.01
    np.testing.assert_allclose(jnp.linalg.norm(start.obs[1:5]), 1.0, rtol=1e-6)


#: What is changed in a task that fits the arm, and what is told.
UNFIT = r"""
xml="<mujoco><worldbudy/></mujoco>" | xml is no model of MuJoCo: .*worldbudy
xml="nowhere.xml" | xml is no model of MuJoCo: .*nowhere.xml
xml=arm(motor="") | actuator '' of the model has no ctrlrange: it must
xml="<mujoco/>" | the model has no actuators
xml=arm().replace("<motor", FILTER) | actuators with activations: its state must be
xml=arm().replace("<motor", '<pid kp="1"') | actuators with several controls, such as p
xml=arm(top='<option><flag sleep="enable"/></option>') | the flag sleep: it must be disa
ls_iterations=0 | ls_iterations is 0: it must be 1 or more
frame_skip=0 | frame_skip is 0: it must be 1 or more
frame_skip=2.5 | frame_skip is 2.5: it must be 1 or more
solver_iterations=0 | solver_iterations is 0: it must be 1 or more
hidden_positions=1 | hidden_positions is 1: it must be .* has 1 entries
healthy_z=(0.0, 1.0) | z_index is 1: it must be an index of qpos
healthy_angle=(0.0, 1.0) | healthy_angle is .* model has no qpos\[2\]
fields=("xpos", "site_xpos") | fields is .*: it must be a tuple of xpos
"""


@pytest.mark.parametrize(("changes", "message"), rows(UNFIT))
def test_a_task_that_does_not_fit_its_model_is_refused(changes, message):
    fitting = {"xml": arm(), "frame_skip": 1, "hidden_positions": 0}
    with pytest.raises(ValueError, match=message) as told:
        Locomotion(Task(**fitting | eval(f"dict({changes})")))
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("what", ["task", "physics", "integrator"])
def test_a_name_that_is_unknown_is_refused(what):
    arguments = {"task": "hopper", "physics": "mujoco", what: "hoper"}
    with pytest.raises(ValueError, match=f"{what} is 'hoper': it must be one of "):
        Locomotion(**arguments)
