"""Sparse tasks by name, as sparse:NAME: mazes, deep sea, a car, and far robots.

Nothing is paid until a long sequence of right actions has succeeded once. A maze is
data: rows of characters, one for each cell. `#` is a wall and `S` the start. `G`, a
goal, and `T`, a treasure, end the episode. `D` is a door, which opens once each key `K`
is taken. `A` is an apple, which pays like the key but leads nowhere. In the tasks whose
names end in _noisy, actions have noise.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from gasil_envs import locomotion, wrappers
from gasil_envs.base import State

#: The reward of each object, which is collected once, and those that end an episode.
REWARDS: Mapping[str, float] = {"G": 1.0, "K": 1.0, "A": 1.0, "T": 10.0}
_ENDING = ("G", "T")
#: The moves of a grid, in rows and columns: up, down, left, right.
_MOVES = np.array([[-1, 0], [1, 0], [0, -1], [0, 1]], np.float32)
#: How far from its cell's middle a point may start, in cells.
_SPREAD = 0.4
_U = (
    "#########",
    "#...G...#",
    "#.......#",
    "#.#####.#",
    "#.#...#.#",
    "#.#.S.#.#",
    "#.......#",
    "#########",
)
_KEY_GRID = (
    "#########",
    "#K..#..A#",
    "#...#...#",
    "#...#.S.#",
    "#...#...#",
    "#.......#",
    "####D####",
    "#.......#",
    "#T......#",
    "#########",
)
_KEYS = (
    "#########",
    "#K..#..A#",
    "#...#...#",
    "#..S....#",
    "####D####",
    "#.......#",
    "#......T#",
    "#########",
)
_APPLE = (
    "#########",
    "#K..#..A#",
    "#...#...#",
    "#.....S.#",
    "####D####",
    "#.......#",
    "#......T#",
    "#########",
)
_ROOMS = (
    "###########",
    "#....#....#",
    "#.S..#....#",
    "#.........#",
    "#....#....#",
    "##.####.###",
    "#....#....#",
    "#....#....#",
    "#.........#",
    "#....#...G#",
    "###########",
)
_KEY_GRID_LARGE = (
    "#############",
    "#K....#....A#",
    "#.....#.....#",
    "#.....#.....#",
    "#.....#...S.#",
    "#.....#.....#",
    "#...........#",
    "######D######",
    "#...........#",
    "#...........#",
    "#T..........#",
    "#############",
)
_U_LARGE = (
    "###########",
    "#....G....#",
    "#.........#",
    "#.#######.#",
    "#.#.....#.#",
    "#.#.....#.#",
    "#.#..S..#.#",
    "#.#.....#.#",
    "#.........#",
    "###########",
)
_TWO_KEYS = (
    "#########",
    "#K..#..K#",
    "#...#...#",
    "#...S...#",
    "####D####",
    "#.......#",
    "#......T#",
    "#########",
)
_FAR_KEY = (
    "###########",
    "#...A.....#",
    "#....S....#",
    "#.........#",
    "#####D###.#",
    "#.......#.#",
    "#......T#K#",
    "###########",
)
#: Two ways lead to the goal, one around each side of a wall. Their mean leads into the
#: dead end inside the wall. Steps are so long that the two ways share only the start.
_TWO_DOORS = (
    "#########",
    "#...G...#",
    "#.......#",
    "#..###..#",
    "#..#.#..#",
    "#.......#",
    "#.......#",
    "#...S...#",
    "#########",
)


@dataclasses.dataclass(frozen=True)
class Layout:
    """A maze and its rules.

    Attributes:
      rows: the cells, from the top; see the module's text.
      episode_length: number of steps after which an episode is truncated.
      speed: number of cells that a point moves at most in a step, in each coordinate;
        None makes the maze a grid, with four moves.
      solved: the return from which on an episode is a success.
    """

    rows: tuple[str, ...]
    episode_length: int
    speed: float | None = 0.3
    solved: float = 1.0


class MazeState(struct.PyTreeNode):
    """The position in cells, float32 (row, column), and what is collected, bool."""

    position: jax.Array
    collected: jax.Array


class Maze:
    """A point, or a piece on a grid, that moves through a `Layout`.

    Observation, float32: the position, from -1 to 1 in each coordinate, or in a grid
    its row and its column, one-hot; then 1 for each object that is still there and 0
    for each that is collected. Action: the velocity as a fraction of `Layout.speed`,
    float32 (2,), or in a grid up, down, left or right.
    """

    def __init__(self, layout: Layout):
        self.layout, self.solved = layout, layout.solved
        self.episode_length = layout.episode_length
        cells = np.array([list(row) for row in layout.rows])
        self._wall, self._door = cells == "#", cells == "D"
        self._start = np.argwhere(cells == "S")[0].astype(np.float32) + 0.5
        self._objects = np.argwhere(np.isin(cells, [*REWARDS]))
        kinds = [cells[tuple(at)] for at in self._objects]
        self._rewards = np.array([REWARDS[kind] for kind in kinds], np.float32)
        self._ending = np.isin(kinds, _ENDING)
        self._is_key = np.isin(kinds, ["K"])
        if layout.speed is None:
            self.num_actions = len(_MOVES)
        else:
            self.action_size = 2
        place = sum(cells.shape) if layout.speed is None else 2
        self.observation_size = place + len(kinds)

    def reset(self, rng: jax.Array) -> State:
        """Start at `S`: a point anywhere near the cell's middle."""
        spread = 0.0 if self.layout.speed is None else _SPREAD
        offset = jax.random.uniform(rng, (2,), jnp.float32, -spread, spread)
        none = jnp.zeros(len(self._rewards), bool)
        state, zero = MazeState(self._start + offset, none), jnp.float32(0)
        return State(state, self._observe(state), zero, zero)

    def step(self, state: State, action: jax.Array) -> State:
        """Move along each coordinate that no wall blocks, and collect what is there."""
        before = state.pipeline_state
        if self.layout.speed is None:
            move = jnp.asarray(_MOVES)[action]
        else:
            move = self.layout.speed * jnp.clip(action, -1.0, 1.0)
        has_keys = jnp.all(before.collected | ~self._is_key)
        closed = self._wall | (self._door & ~has_keys)
        position = before.position
        for axis in range(2):
            moved = position.at[axis].add(move[axis])
            row, column = moved.astype(jnp.int32)
            position = jnp.where(closed[row, column], position, moved)
        cell = position.astype(jnp.int32)
        here = jnp.all(cell[None] == self._objects, axis=-1)
        taken = here & ~before.collected
        after = MazeState(position, before.collected | taken)
        return state.replace(
            pipeline_state=after,
            obs=self._observe(after),
            reward=jnp.sum(jnp.where(taken, self._rewards, 0.0)),
            done=jnp.any(taken & self._ending).astype(jnp.float32),
        )

    def _observe(self, state: MazeState) -> jax.Array:
        shape = self._wall.shape
        if self.layout.speed is None:
            cell = state.position.astype(jnp.int32)
            place = jnp.concatenate([jax.nn.one_hot(x, n) for x, n in zip(cell, shape)])
        else:
            place = 2.0 * state.position / np.array(shape, np.float32) - 1.0
        return jnp.concatenate([place, 1.0 - state.collected.astype(jnp.float32)])

    def draw(self, state: MazeState, size: tuple[int, int]) -> np.ndarray:
        """Return a picture of the maze, with the point in black."""
        colors = {"#": (70, 70, 80), "D": (150, 90, 40), "K": (0, 114, 178)}
        colors |= {"A": (213, 94, 0), "G": (0, 158, 115), "T": (230, 159, 0)}
        cells = np.array([list(row) for row in self.layout.rows])
        picture = np.full((*cells.shape, 3), 245, np.uint8)
        for kind, color in colors.items():
            picture[cells == kind] = color
        for at in self._objects[np.asarray(state.collected)]:
            picture[tuple(at)] = 225
        if np.all(np.asarray(state.collected) | ~self._is_key):
            picture[self._door] = 225
        return _enlarged(picture, size, np.asarray(state.position))


class DeepSea:
    """A diver on a square grid who sinks a row in each step, to the left or right.

    Each move to the right costs 0.01 / size, and only moves to the right alone reach
    the chest, which pays 1 (bsuite's deep sea). Which of the two actions is right
    differs from cell to cell. Observation: row and column, one-hot.
    """

    num_actions = 2
    solved = 0.9

    def __init__(self, size: int):
        self.episode_length, self.observation_size = size, 2 * size + 1
        self._size = size
        self._right = np.random.default_rng(size).integers(2, size=(size + 1, size))

    def reset(self, rng: jax.Array) -> State:
        """Start at the top left."""
        cell, zero = jnp.zeros(2, jnp.int32), jnp.float32(0)
        return State(cell, self._observe(cell), zero, zero)

    def step(self, state: State, action: jax.Array) -> State:
        """Sink by one row; the last row ends the episode."""
        row, column = state.pipeline_state
        right = action == jnp.asarray(self._right)[row, column]
        found = right & (row == self._size - 1) & (column == self._size - 1)
        column = jnp.clip(column + jnp.where(right, 1, -1), 0, self._size - 1)
        cell = jnp.stack([row + 1, column])
        return state.replace(
            pipeline_state=cell,
            obs=self._observe(cell),
            reward=found.astype(jnp.float32) - right * 0.01 / self._size,
            done=(row + 1 >= self._size).astype(jnp.float32),
        )

    def _observe(self, cell: jax.Array) -> jax.Array:
        sizes = (self._size + 1, self._size)
        return jnp.concatenate([jax.nn.one_hot(x, n) for x, n in zip(cell, sizes)])

    def draw(self, state: jax.Array, size: tuple[int, int]) -> np.ndarray:
        """Return a picture of the sea, with the diver in black."""
        sea = np.full((self._size + 1, self._size, 3), 235, np.uint8)
        sea[-1, -1] = (230, 159, 0)
        return _enlarged(sea, size, np.asarray(state) + 0.5)


class MountainCar:
    """A car in a valley that must swing up to get out, and pays for each push.

    This is the continuous mountain car. Observation, float32 (2,): the position, and
    ten times the velocity. Action, float32 (1,): the force, from -1 to 1. Leaving on
    the right pays 100 and ends the episode, and each step costs 0.1 times its force
    squared.
    """

    observation_size, action_size, episode_length, solved = 2, 1, 999, 80.0

    def reset(self, rng: jax.Array) -> State:
        """Start at rest near the bottom."""
        position = jax.random.uniform(rng, (), jnp.float32, -0.6, -0.4)
        at, zero = jnp.stack([position, jnp.float32(0)]), jnp.float32(0)
        return State(at, self._observe(at), zero, zero)

    def step(self, state: State, action: jax.Array) -> State:
        """Push, and roll."""
        position, velocity = state.pipeline_state
        force = jnp.clip(action[0], -1.0, 1.0)
        velocity += 0.0015 * force - 0.0025 * jnp.cos(3.0 * position)
        velocity = jnp.clip(velocity, -0.07, 0.07)
        position = jnp.clip(position + velocity, -1.2, 0.6)
        velocity = jnp.where((position <= -1.2) & (velocity < 0.0), 0.0, velocity)
        done = ((position >= 0.45) & (velocity >= 0.0)).astype(jnp.float32)
        at = jnp.stack([position, velocity])
        reward = 100.0 * done - 0.1 * force**2
        return state.replace(
            pipeline_state=at, obs=self._observe(at), reward=reward, done=done
        )

    def _observe(self, at: jax.Array) -> jax.Array:
        return at * jnp.array([1.0, 10.0])

    def draw(self, state: jax.Array, size: tuple[int, int]) -> np.ndarray:
        """Return a picture of the valley, with the car in black."""
        columns = np.linspace(-1.2, 0.6, 90)
        ground = (20 * (1.0 - np.sin(3.0 * columns))).astype(int) + 5
        picture = np.full((50, 90, 3), 245, np.uint8)
        picture[np.arange(50)[:, None] >= ground] = (150, 150, 150)
        column = (float(state[0]) + 1.2) / 1.8 * 89
        return _enlarged(picture, size, np.array([ground[int(column)] - 1, column]), 2)


class FarRobot(locomotion.Locomotion):
    """A robot that gets 1 for each step that ends beyond a distance, and no more.

    VIME's SparseHalfCheetah (Houthooft et al. 2016) is this with 5 m. Episodes end as
    in the robot's own task. All of its position is observed, as it decides the reward.

    Args:
      name: the robot, one of `locomotion.TASKS`.
      metres: the distance.
    """

    solved = 500.0

    def __init__(self, name: str, metres: float):
        task = dataclasses.replace(
            locomotion.TASKS[name],
            gymnasium_id=None,
            forward_reward=0.0,
            control_cost=0.0,
            contact_cost=None,
            healthy_reward=1.0,
            paid_beyond=metres,
            hidden_positions=0,
        )
        super().__init__(task)


def _enlarged(
    cells: np.ndarray, size: tuple[int, int], at: np.ndarray, radius: float = 0.35
) -> np.ndarray:
    """Return cells (rows, columns, 3) as a picture with a black disc.

    Args:
      cells: the color of each cell, uint8.
      size: width and height of the picture.
      at: (row, column) of the disc's centre, in cells.
      radius: its radius, in cells.
    """
    width, height = size
    row = (np.arange(height)[:, None] + 0.5) * cells.shape[0] / height
    column = (np.arange(width)[None, :] + 0.5) * cells.shape[1] / width
    picture = cells[row.astype(int), column.astype(int)].copy()
    picture[(row - at[0]) ** 2 + (column - at[1]) ** 2 < radius**2] = 0
    return picture


#: The distance beyond which each robot is paid, in metres.
ROBOTS: Mapping[str, float] = {
    "hopper": 1.0,
    "halfcheetah": 12.0,
    "walker2d": 1.0,
    "swimmer": 3.0,
    "ant": 3.0,
    "humanoid": 0.6,
}
#: The tasks without noise, by name: a maze has its `Layout`, deep sea the size of its
#: grid, mountain car None, and a robot the distance that it must go, in metres.
TASKS: Mapping[str, Any] = {
    "u_maze": Layout(_U, 150),
    "u_maze_short": Layout(_U, 100),
    "key_maze": Layout(_KEYS, 200, speed=0.25, solved=10.0),
    "key_maze_short": Layout(_KEYS, 120, speed=0.25, solved=10.0),
    "apple_maze": Layout(_APPLE, 200, speed=0.25, solved=10.0),
    "four_rooms": Layout(_ROOMS, 150, speed=0.25),
    "key_grid": Layout(_KEY_GRID, 50, speed=None, solved=10.0),
    "deep_sea_10": 10,
    "deep_sea_20": 20,
    "mountain_car": None,
    "key_grid_large": Layout(_KEY_GRID_LARGE, 100, speed=None, solved=10.0),
    "u_maze_large": Layout(_U_LARGE, 150),
    "two_keys_maze": Layout(_TWO_KEYS, 200, speed=0.25, solved=10.0),
    "far_key_maze": Layout(_FAR_KEY, 250, speed=0.3, solved=10.0),
    "two_doors": Layout(_TWO_DOORS, 25, speed=1.0),
    **ROBOTS,
}
#: The suffix of tasks with noise on the actions, and `wrappers.ActionNoise.scale` for
#: actions that are vectors and for discrete ones.
_NOISY, _NOISE = "_noisy", {"vector": 0.5, "discrete": 0.1}


def names() -> tuple[str, ...]:
    """Return the names of the tasks, without and with noise on the actions."""
    return (*TASKS, *(f"{name}{_NOISY}" for name in TASKS))


def build(name: str) -> Any:
    """Build a task; its attribute `solved` is the return from which on it is solved.

    Args:
      name: one of `names`.
    """
    bare = name.removesuffix(_NOISY)
    task = TASKS[bare]
    env: Any
    if isinstance(task, Layout):
        env = Maze(task)
    elif bare in ROBOTS:
        env = FarRobot(bare, task)
    else:
        env = MountainCar() if task is None else DeepSea(task)
    if not name.endswith(_NOISY):
        return env
    kind = "discrete" if wrappers.is_discrete(env) else "vector"
    return wrappers.ActionNoise(env, _NOISE[kind])
