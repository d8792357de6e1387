"""Every environment under jit and vmap, and one step of each against Gymnasium."""

import functools

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from against_mujoco import products_at_once
from environment_contract import BATCH, check_reset_and_step
from plain_numpy import Program
from refusals import rows

import gasil_envs
from gasil_envs import locomotion, user_environment, wrappers
from gasil_envs.physics.interface import PhysicsState

# One worker for each environment, so that it is compiled once; and one of them, because
# that takes long, as for users.
EACH_NAME = [
    pytest.param(
        name,
        marks=[
            pytest.mark.xdist_group(name),
            *([pytest.mark.compiled_as_for_users] if name == "hopper" else []),
        ],
    )
    for name in gasil_envs.names()
]


@functools.cache
def env_and_functions(name, physics="jax"):
    """The environment, and its jitted and vmapped reset and step."""
    env = gasil_envs.make(name, physics=physics)
    return env, jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step))


def test_reset_and_step_of_the_point_mass():
    check_reset_and_step(*env_and_functions("point_mass"))


def gymnasium_transitions(name):
    """Steps of a random policy in Gymnasium: all falls, and others to make BATCH."""
    env = gymnasium.make(locomotion.TASKS[name].gymnasium_id).unwrapped
    task = locomotion.TASKS[name]

    def position_of(model, data):
        if task.position is None:
            return data.qpos[:2]
        return task.position(model, {name: getattr(data, name) for name in task.fields})

    env.action_space.seed(0)
    env.reset(seed=0)
    steps = []
    for _ in range(3 * BATCH):
        data = env.data
        before = [data.qpos.copy(), data.qvel.copy(), data.qacc_warmstart.copy()]
        # Velocity is measured from where the last evaluation of the dynamics was.
        before.append(np.array(position_of(env.model, data)))
        action = env.action_space.sample()
        observation, reward, terminated, *_ = env.step(action)
        steps.append((*before, action, observation, reward, terminated))
        if terminated:
            env.reset()
    falls = [step for step in steps if step[-1]][: BATCH // 4]
    others = [step for step in steps if not step[-1]]
    spaced = np.linspace(0, len(others) - 1, BATCH - len(falls)).astype(int)
    chosen = falls + [others[i] for i in spaced]
    return tuple(np.stack(column) for column in zip(*chosen))


# The largest errors are of steps in which a contact or limit begins or ends: there
# the acceleration jumps, and a rounding of the state decides in which substep.
@pytest.mark.parametrize("physics", ["jax", "mujoco"])
@pytest.mark.parametrize("name", EACH_NAME[1:])
def test_one_step_equals_gymnasiums(name, physics):
    if physics == "jax" and name == "humanoidstandup":
        pytest.skip("it has humanoid's model")
    env, reset, step = env_and_functions(name, physics)
    # Here, and not in a test of its own, so that a step is compiled once. Resets with
    # our own physics, slow to compile, are those of test_mazes.py.
    if physics == "mujoco":
        check_reset_and_step(env, reset, step)
    transitions = gymnasium_transitions(name)
    *before, action = (jnp.asarray(x, jnp.float32) for x in transitions[:5])
    observation, reward, terminated = transitions[5:]
    assert terminated.any() or not env.ends_early or name == "ant"

    # Of a state a step looks at these alone, so that nothing is compiled for the rest.
    qpos, qvel, warmstart, position = before
    state = jax.tree.map(
        lambda x: jnp.zeros((BATCH, *x.shape), x.dtype),
        jax.eval_shape(env.reset, jax.random.key(0)),
    )
    begin = PhysicsState(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart)
    inner = state.pipeline_state.replace(physics=begin, position=position)
    state = state.replace(pipeline_state=inner)
    if physics == "jax" and name != "hopper":
        # To compile it takes up to a minute, and other tests compile such steps.
        with products_at_once():
            program = Program(jax.vmap(env.step), state, action)
        step = functools.partial(program, dtype=np.float32)
    state = step(state, action)
    error = np.abs(state.obs - observation) / (1.0 + np.abs(observation))
    error = error.max(axis=1)  # the worst entry of each step
    reward_error = np.abs(state.reward - reward) / (1.0 + np.abs(reward))
    quantiles = (0.5, 0.9, 0.99, 1.0)
    show = lambda x: np.array2string(np.quantile(x, quantiles), precision=1)
    print(f"{name}, {physics}: quantiles {quantiles} of the relative error of one step")
    print("  observation", show(error))
    print("  reward", show(reward_error))
    assert np.median(error) < 1e-5
    assert np.quantile(error, 0.9) < 1e-3
    assert np.median(reward_error) < 1e-5
    assert np.quantile(reward_error, 0.99) < 2e-2
    np.testing.assert_array_equal(state.done, terminated)


def gymnasium_resets(name):
    """The model, and qpos and qvel (BATCH, ...) at the start of its episodes."""
    env = gymnasium.make(locomotion.TASKS[name].gymnasium_id).unwrapped
    env.reset(seed=0)
    starts = []
    for _ in range(BATCH):
        env.reset()
        starts.append((env.data.qpos.copy(), env.data.qvel.copy()))
    return env.model, *map(np.stack, zip(*starts))


# With MuJoCo's physics, whose resets the test above compiles too.
@pytest.mark.parametrize("name", EACH_NAME[1:])
def test_episodes_start_where_gymnasiums_do(name):
    _, reset, _ = env_and_functions(name, "mujoco")
    physics = reset(jax.random.split(jax.random.key(0), BATCH)).pipeline_state.physics
    model, *theirs = gymnasium_resets(name)
    ours = [np.asarray(physics.qpos), np.asarray(physics.qvel)]
    if model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE:
        # Gymnasium leaves it to MuJoCo to make a rotation's quaternion a unit.
        np.testing.assert_allclose(np.linalg.norm(ours[0][:, 3:7], axis=1), 1, 1e-6)
        tangents = lambda qpos: qpos[:, 4:7] / qpos[:, 3:4]
        for x in ours, theirs:
            x[0] = np.concatenate([x[0][:, :3], tangents(x[0]), x[0][:, 7:]], axis=1)
    for field, our, their in zip(("qpos", "qvel"), ours, theirs):
        normal = field == "qvel" and locomotion.TASKS[name].normal_velocity_noise
        for of, quantity, most in (
            ("deviation", np.std, 0.3),
            ("mean", np.mean, 0.5),
            # The largest of many normal numbers varies more than that of uniform ones.
            ("lowest", np.min, 2.5 if normal else 0.2),
            ("highest", np.max, 2.5 if normal else 0.2),
        ):
            error = np.abs(quantity(our, axis=0) - quantity(their, axis=0))
            # Some entries are the same in all episodes: there no error is allowed.
            error = error / np.maximum(their.std(axis=0), 1e-9)
            print(f"{name}, {field}: {of} differs by {error.max():.2f} deviations")
            assert error.max() < most, (field, of, error.argmax())


def test_point_mass_against_a_plain_python_twin():
    env = gasil_envs.make("point_mass")
    layout = env.env.layout
    step = jax.jit(env.step)
    state = jax.jit(env.reset)(jax.random.key(0))
    objects = [(p, layout.blue_reward) for p in layout.blue]
    objects += [(p, layout.green_reward) for p in layout.green]
    objects += [(p, layout.orange_reward) for p in layout.orange]
    position = np.array(state.obs[:2], np.float64)
    left = [True] * len(objects)
    total = collected = 0.0
    rng = np.random.default_rng(1)
    target = 0
    for t in range(layout.episode_length):
        # From object to object, with noise, beyond the limits now and then.
        if not left[target]:
            target = (target + 3) % len(objects)
        action = 3.0 * (np.array(objects[target][0]) - position)
        action = (action + rng.normal(size=2)).astype(np.float32)
        limited = np.clip(action, -1.0, 1.0)
        position = np.clip(position + layout.max_speed * limited, -1.0, 1.0)
        reward = -layout.actuation_cost * np.sqrt(np.sum(limited**2))
        for i, (centre, value) in enumerate(objects):
            if left[i] and np.hypot(*(position - centre)) <= layout.radius:
                left[i] = False
                reward += value
                collected += 1
        state = step(state, jnp.asarray(action))
        np.testing.assert_allclose(state.obs[:2], position, atol=1e-5)
        np.testing.assert_array_equal(state.obs[2:], np.array(left, np.float32))
        np.testing.assert_allclose(state.reward, reward, atol=1e-5)
        last = t == layout.episode_length - 1
        assert bool(state.done) == bool(state.info["truncation"]) == last
        total += reward
    assert collected >= 3


_OWN = """
import jax.numpy as jnp
from brax.envs import Env, State
class Env(Env):
    observation_size, action_size, backend = 2, 1, "none"
    def reset(self, rng):
        return State(jnp.int32(0), jnp.zeros(2), jnp.float32(0), jnp.float32(0))
    def step(self, state, action):
        then, a = state.pipeline_state + 1, jnp.zeros(2)
        reward = action[0]
        return state.replace(pipeline_state=then, obs=a, reward=reward, info={})
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A function that writes a module, and returns the name of its environment."""
    monkeypatch.syspath_prepend(tmp_path)

    def write(module):
        name = f"own_{abs(hash(module))}"
        (tmp_path / f"{name}.py").write_text(module)
        return f"{name}:Env"

    return write


def test_an_environment_of_the_user_is_built(own):
    env = gasil_envs.make(own(_OWN), reward_delay=3)
    assert env.step(env.reset(jax.random.key(0)), jnp.zeros(1)).pipeline_state == 1
    told = _OWN.replace("info={}", "info={**state.info, 'truncation': then > 2}")
    gasil_envs.make(own(told), reward_delay=3)


#: What stands in `_OWN`, what stands there instead (or below it), and what is told.
FAULTS = r"""
import | 1 / 0; import | be imported: ZeroDivisionError: division by zero \(.*line 2
import | Env = ; import | can't be imported: SyntaxError: invalid syntax .*line 2
return State | raise SystemExit(4); State | can't be traced: SystemExit: 4 \(.*line 7
2, 1, | 2.5, 1, | size 2.5: it must be a whole
2, 1, | 3, 1, | obs of its reset .*\(2,\): .* \(3,\)
action[0] | action | reward of its step .*\(1,\): .* \(\)
action[0] | self.gain | AttributeError: .*gain.*line 10
obs=a | obs={'x': a} | step is a dict: it .* \(2,\)
obs=a | obs=len | obs of its step is <built-in function len
obs=a | obs=a, done=None | done of its step is a NoneType
info={} | info=None | the info of its step is None: it must
zeros(2) | zeros(2, int) | obs of its reset is int32: it
reward=reward | reward=reward > 0 | the reward of its step is bool: it must be float32
pipeline_state + 1 | pipeline_state + 0.5 | is int32\[\] after its reset and float32
info={} | info={'x': a} | info\['x'\] is missing after i
info={} | info={'true_reward': a} | info\['true_reward'\] of its step has shape \(2,\)
return state | return a, 0, {}; state | its step returns a tuple: it must return a bra
END | reset = 3 | has reset 3: it must be a function
END | observation_size = property(lambda self: exit()) | built: SystemExit: None .*ne 12
END | episode_length = 0 | has episode_length 0: it must be a whole
END | action_range = 0.5 | has action_range 0.5: it must be the low
END | action_range = (1, -1) | has action_range \(1, -1\): it must
"""


@pytest.mark.parametrize(("old", "new", "message"), rows(FAULTS))
def test_a_fault_of_the_users_environment_is_one_line(old, new, message, own):
    module = f"{_OWN}    {new}\n" if old == "END" else _OWN.replace(old, new, 1)
    with pytest.raises(ValueError, match=message) as refused:
        gasil_envs.make(own(module))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("low", "high", "allowed", "executed"),
    # `_OWN` rewards an action.
    [(-100, 100, (-1, 1), 50.0), (2, 4, (-1, 1), 3.5), (-1, 3, (-1, 3), 0.5)],
)
def test_actions_of_a_wide_range_are_in_units_of_it(
    low, high, allowed, executed, own, caplog
):
    module = _OWN + f"    action_range = ({low}, {high})\n"
    env = gasil_envs.make(own(module))
    assert wrappers.action_range(env) == allowed
    state = env.step(env.reset(jax.random.key(0)), jnp.full(1, 0.5))
    assert state.reward == executed and not caplog.text
    user_environment.check("Env", env.unwrapped, env.unwrapped)
    assert ("wrap it in gasil_envs.wrappers.UnitActions" in caplog.text) is (
        allowed == (-1, 1)
    )


def test_the_euler_integrator_is_mujocos():
    env = gasil_envs.make("hopper", physics="mujoco", integrator="euler")
    state, action = jax.jit(env.reset)(jax.random.key(0)), jnp.full(3, 0.5)
    model = gymnasium.make("Hopper-v5").unwrapped.model
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    data, start = mujoco.MjData(model), state.pipeline_state.physics
    data.qpos[:], data.qvel[:], data.ctrl[:] = start.qpos, start.qvel, action
    mujoco.mj_step(model, data, 4)
    after = jax.jit(env.step)(state, action).pipeline_state.physics
    np.testing.assert_allclose(after.qpos, data.qpos, atol=1e-6)
    np.testing.assert_allclose(after.qvel, data.qvel, atol=1e-6)
