"""The sparse tasks: the contract, their rules, and that each can be solved."""

import collections

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from environment_contract import BATCH, check_reset_and_step

import gasil_envs
from gasil_envs import locomotion, mazes, pictures, user_environment, wrappers


def is_robot(name):
    return name.removesuffix("_noisy") in mazes.ROBOTS


@pytest.mark.parametrize("name", [x for x in mazes.names() if not is_robot(x)])
def test_reset_and_step(name):
    env = gasil_envs.make(f"sparse:{name}")
    user_environment.check(name, env.env, env)
    reset, step = jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step))
    check_reset_and_step(env, reset, step, same_start=wrappers.is_discrete(env))
    state = env.reset(jax.random.key(0)).pipeline_state
    picture = pictures.painter(env, (60, 40)).draw([jax.tree.map(np.asarray, state)])
    assert picture.shape == (40, 60, 3) and picture.min() < 20 < picture.max()


@pytest.mark.parametrize("name", ["hopper", "halfcheetah"])
def test_a_robot_is_paid_for_each_healthy_step_beyond_its_distance_alone(name):
    # With MuJoCo's physics, of which nothing takes long to compile.
    task = gasil_envs.make(f"sparse:{name}").unwrapped.task
    env = locomotion.Locomotion(task, physics="mujoco")
    user_environment.check(name, env, env)
    reset, step = jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step))
    check_reset_and_step(env, reset, step)
    start = reset(jax.random.split(jax.random.key(0), BATCH))
    physics = start.pipeline_state.physics
    metres = mazes.ROBOTS[name]
    moved = metres + jnp.linspace(-0.1, 0.1, BATCH)
    # Every other robot lies on its head, which ends a hopper's episode.
    qpos = physics.qpos.at[:, 0].set(moved).at[::2, 2].set(2.0)
    inner = start.pipeline_state.replace(physics=physics.replace(qpos=qpos))
    after = step(
        start.replace(pipeline_state=inner), jnp.zeros((BATCH, env.action_size))
    )
    x = np.array(after.pipeline_state.physics.qpos[:, 0])
    paid = (x > metres) & ~np.array(after.done, bool)
    np.testing.assert_array_equal(after.reward, np.where(paid, 1.0, 0.0))
    assert 0.2 < paid.mean() < 0.6 and (after.done.mean() == 0.5) == env.ends_early
    # What decides the reward is seen.
    np.testing.assert_array_equal(after.obs[:, 0], x)


@pytest.mark.parametrize("name", mazes.ROBOTS)
def test_a_robot_sees_all_of_its_position_and_moves_as_in_its_own_task(name):
    env, own = gasil_envs.make(f"sparse:{name}"), locomotion.TASKS[name]
    theirs = gasil_envs.make(name).unwrapped
    assert env.observation_size == theirs.observation_size + own.hidden_positions
    assert env.action_size == theirs.action_size
    assert env.unwrapped.ends_early == theirs.ends_early
    assert env.unwrapped.solved < env.episode_length
    # A start of its own task is observed as there.
    key = jax.random.key(0)
    first, own_first = jax.jit(lambda: (env.reset(key).obs, theirs.reset(key).obs))()
    np.testing.assert_array_equal(first[own.hidden_positions :], own_first)


MAZES = [name for name, x in mazes.TASKS.items() if isinstance(x, mazes.Layout)]


def shortest(rows, start, goals, closed):
    """The cells on a shortest way, the start included, by breadth-first search."""
    came_from, waiting = {start: None}, collections.deque([start])
    while waiting:
        cell = waiting.popleft()
        if cell in goals:
            way = [cell]
            while came_from[way[-1]] is not None:
                way.append(came_from[way[-1]])
            return way[::-1]
        for move in mazes._MOVES.astype(int):
            other = (cell[0] + int(move[0]), cell[1] + int(move[1]))
            if rows[other[0]][other[1]] not in closed and other not in came_from:
                came_from[other] = cell
                waiting.append(other)
    raise AssertionError("there is no way")


def cells_of(rows, kinds):
    return {
        (i, j) for i, row in enumerate(rows) for j, x in enumerate(row) if x in kinds
    }


@pytest.mark.parametrize("name", MAZES)
def test_a_maze_can_be_solved_in_its_time(name):
    env = gasil_envs.make(f"sparse:{name}")
    layout = env.unwrapped.layout
    rows, at = layout.rows, min(cells_of(layout.rows, "S"))
    way = [at]
    for key in sorted(cells_of(rows, "K")):
        way += shortest(rows, way[-1], {key}, "#D")[1:]
    way += shortest(rows, way[-1], cells_of(rows, "GT"), "#")[1:]
    state, step, total = env.reset(jax.random.key(0)), jax.jit(env.step), 0.0
    for cell in way[1:]:
        # Towards the next cell's middle, as far as one step goes, until it is reached.
        while True:
            position = np.asarray(state.pipeline_state.position)
            ahead = np.array(cell) + 0.5 - position
            if layout.speed is None:
                action = jnp.int32(np.argmax(mazes._MOVES @ ahead))
            else:
                action = jnp.array(ahead / layout.speed, jnp.float32)
            state = step(state, action)
            total += float(state.reward)
            if state.done or np.abs(ahead).max() <= (layout.speed or 1.0):
                break
        if state.done:
            break
    assert total >= layout.solved and not wrappers.truncated(state)
    assert state.info["steps"] < 0.8 * layout.episode_length


def test_a_door_opens_with_the_key_alone_and_an_object_pays_once():
    env = mazes.Maze(mazes.Layout(("#####", "#SKD#", "#A.T#", "#####"), 9, None, 10.0))
    moves = {"up": 0, "down": 1, "left": 2, "right": 3}

    def walk(*names):
        state, rewards = env.reset(jax.random.key(0)), []
        for name in names:
            state = env.step(state, jnp.int32(moves[name]))
            rewards.append(float(state.reward))
        return state, rewards

    state, rewards = walk("right", "left", "right", "right", "down")
    assert rewards == [1, 0, 0, 0, 10] and state.done
    shut = mazes.Maze(mazes.Layout(("#####", "#SDT#", "#K..#", "#####"), 9, None, 10.0))
    state = shut.reset(jax.random.key(0))
    blocked = shut.step(state, jnp.int32(3))
    np.testing.assert_array_equal(
        blocked.pipeline_state.position, state.pipeline_state.position
    )
    state, rewards = walk("down", "up", "up")
    assert rewards == [1, 0, 0] and not state.done  # An apple; then a wall.


@pytest.mark.parametrize("size", [10, 20])
def test_only_the_right_actions_reach_the_chest(size):
    env = gasil_envs.make(f"sparse:deep_sea_{size}")
    state, total = env.reset(jax.random.key(0)), 0.0
    for i in range(size):
        assert not state.done
        state = env.step(state, jnp.int32(env.unwrapped._right[i, i]))
        total += float(state.reward)
    assert state.done and not wrappers.truncated(state)
    assert total == pytest.approx(0.99) and total >= env.unwrapped.solved


def test_a_car_that_pushes_with_its_velocity_leaves():
    env = gasil_envs.make("sparse:mountain_car")

    def push(state, _):
        state = env.step(state, jnp.sign(state.pipeline_state[1:] + 1e-6))
        return state, (state.reward, state.done)

    start = env.reset(jax.random.key(0))
    rewards, done = jax.jit(lambda x: jax.lax.scan(push, x, length=300)[1])(start)
    steps = int(np.argmax(done)) + 1
    assert done.any() and rewards[:steps].sum() >= env.unwrapped.solved


def test_noise_changes_actions_and_is_decided_by_the_key_of_the_reset():
    def moves(name, noise, action):
        """From 1000 starts, how far a step with noise goes."""
        env = wrappers.ActionNoise(mazes.build(name), noise)

        def move(key):
            state = env.reset(key)
            after = env.step(state, action)
            return after.pipeline_state.position - state.pipeline_state.position

        keys = jax.random.split(jax.random.key(0), 1000)
        return np.array(jax.jit(jax.vmap(move))(keys))

    # Its velocity is the speed times noise of half a deviation.
    moved = moves("u_maze", 0.5, jnp.zeros(2))
    assert np.std(moved) == pytest.approx(0.15, rel=0.1)
    np.testing.assert_array_equal(moved, moves("u_maze", 0.5, jnp.zeros(2)))
    # A random one of four moves, the one that was asked for among them.
    down = moves("key_grid", 0.4, jnp.int32(1))[:, 0] == 1
    assert np.mean(down) == pytest.approx(0.7, abs=0.05)
