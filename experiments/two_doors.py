"""How many of two ways to succeed a policy keeps, with one Gaussian and with several.

In the maze two_doors a way leads to the goal on either side of a wall, and the mean of
both leads into the wall. Two agents imitate the same episodes, one half of which takes
each way, and never see a reward: so nothing but the imitation decides. Three learn from
the reward and their own buffer; as "shared" they rank it with --sharing-distance 0.5,
the first value that was tried. After training, episodes are counted that reach the
goal on each side: of the policy, with drawn actions and with the most probable ones,
and in the buffer. A seed solves the maze if nine in ten of its episodes reach the goal,
and keeps both ways if one in ten takes each.

The maze and the number of given episodes were chosen with a few seeds of cloning, for
how often one Gaussian fails. Settings are not tuned.
"""

import csv
import dataclasses
import functools
import pathlib
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import gasil_jax
from experiments.report import markdown_table
from experiments.search import SPARSE_BASE, Point
from experiments.store import RESULTS, ResultsFolder
from gasil_envs import wrappers
from gasil_jax import PPOBC, policy
from gasil_jax.agents import AGENTS
from gasil_jax.buffer import GoodTrajectories
from gasil_jax.context import Context, Metrics, Sizes
from gasil_jax.errors import InputError, unknown
from gasil_jax.export_minari import episodes
from gasil_jax.host import command_line, devices, output_file
from gasil_jax.host.environments import Settings

ENV = "sparse:two_doors"
COMPONENTS = (1, 4)
#: Episodes of the data on each side, so many that a network can't tell the sides by
#: where each of them happened to start; and those that are counted for each seed.
_EACH_WAY, _COUNTED = 256, 64
#: A policy keeps a way if this share of its episodes takes it, and solves the maze if
#: this share reaches the goal.
_KEPT, _SOLVED = 0.1, 0.9
#: What is counted of each seed, on the left and on the right.
_COLUMNS = ("drawn", "most probable", "buffer")


@dataclasses.dataclass(frozen=True)
class Options:
    """Count how many of two ways to succeed policies keep.

    Attributes:
      seeds: number of seeds of each agent.
      total_steps: environment steps of each seed.
      only: agents to train, with one Gaussian and with several; default all.
      runs: folder of the runs, which are continued where they were interrupted.
      out: folder of the two tables, which are replaced.
    """

    seeds: int = 20
    total_steps: int = 200_000
    only: tuple[str, ...] = ()
    runs: pathlib.Path = pathlib.Path("runs", "two_doors")
    out: ResultsFolder = RESULTS


@functools.cache
def demonstrations() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return observations, actions and steps of episodes that take both ways.

    They head for the near corner of the wall, its far corner and the goal.
    """
    env = gasil_jax.make_env(ENV)
    step, speed = jax.jit(env.step), env.unwrapped.layout.speed
    rows: list[tuple[np.ndarray, np.ndarray, int]] = []
    for seed in range(2 * _EACH_WAY):
        state, side = env.reset(jax.random.key(seed)), 2 * (seed % 2) - 1
        corners = [np.array((row, 4.5 + 2.1 * side)) for row in (5.2, 2.5)]
        for time in range(env.unwrapped.episode_length):
            at = np.asarray(state.pipeline_state.position)
            if len(corners) and np.abs(corners[0] - at).max() < speed / 2:
                corners.pop(0)
            target = corners[0] if corners else np.array((1.5, 4.5))
            ahead = (target - at) / speed
            action = (ahead / max(1.0, np.abs(ahead).max())).astype(np.float32)
            rows.append((np.asarray(state.obs), action, time))
            state = step(state, action)
            if state.done:
                break
    columns = [np.array(x) for x in zip(*rows, strict=True)]
    return columns[0], columns[1], columns[2]


class Cloning(PPOBC):
    """PPO+BC without PPO: it clones `demonstrations` in place of its own episodes."""

    uses_reward = False

    def init(self, key: jax.Array, sizes: Sizes) -> GoodTrajectories:
        """Return the demonstrations as a buffer."""
        with jax.ensure_compile_time_eval():
            observation, action, time = map(jnp.asarray, demonstrations())
        return GoodTrajectories(
            observation, action, jnp.ones(len(time)), time, jnp.int32(len(time))
        )

    def remember(self, state: Any, context: Context) -> Any:
        """Return the demonstrations as they are."""
        return state

    def mix(
        self, state: Any, advantages: jax.Array, context: Context
    ) -> tuple[jax.Array, Metrics]:
        """Return advantages of 0, so that PPO leaves the policy as it is."""
        return jnp.zeros_like(advantages[..., 0]), {}


_CLONING = {"behavior_cloning_coefficient": 1.0}
#: Agents that learn from the reward and their own buffer, by name.
_LEARNING: Mapping[str, tuple[str, Point]] = {
    title: (name, {**SPARSE_BASE, "entropy_coefficient": 0.01, **own})
    for title, name, own in (
        ("ppo+bc", "ppo+bc", _CLONING),
        ("ppo+bc+novelty", "ppo+bc+novelty", _CLONING),
        ("ppo+gasil, centered", "ppo+gasil", {"alpha": 0.1, "bonus": "centered"}),
    )
}
#: All agents by name, each with its settings. Where it is shared, episodes of one way
#: share their return in the buffer.
AGENTS_OF: Mapping[str, tuple[str, Point]] = {
    "cloning of given episodes": (
        Cloning.name,
        {
            "num_epochs": 1,
            "learning_rate": 1e-3,
            "behavior_cloning_updates": 100,
            **_CLONING,
        },
    ),
    "gail": (
        "gail",
        {
            "alpha": 1.0,
            "bonus": "centered",
            "discriminator_updates": 20,
            "discriminator_learning_rate": 3e-4,
            "entropy_coefficient": 0.01,
        },
    ),
    **_LEARNING,
    **{
        f"{title}, shared": (name, {**point, "sharing_distance": 0.5})
        for title, (name, point) in _LEARNING.items()
    },
}


def side(across: Any, xp: Any = np) -> Any:
    """Return on which side of the wall an episode passes: -1 or 1.

    Args:
      across: how far right of the middle each of its steps is, (steps,).
      xp: the array module, numpy or jax.numpy.
    """
    return xp.sign(across[xp.argmax(xp.abs(across))])


def ways_of_policy(
    env: Any, state: Any, key: jax.Array, *, deterministic: bool
) -> jax.Array:
    """Return the shares of episodes that reach the goal on the left and right, (2,)."""
    act = policy.from_state(state, env)

    def episode(key: jax.Array) -> jax.Array:
        reset_key, key = jax.random.split(key)

        def step(carry: Any, key: jax.Array) -> Any:
            state, running, total = carry
            across = jnp.where(running, state.obs[1], 0.0)
            state = env.step(state, act(state.obs, None if deterministic else key))
            total += jnp.where(running, state.reward, 0.0)
            running &= ~((state.done > 0) | wrappers.truncated(state))
            return (state, running, total), across

        start = env.reset(reset_key), jnp.bool_(True), jnp.float32(0)
        keys = jax.random.split(key, env.unwrapped.episode_length)
        (_, _, total), across = jax.lax.scan(step, start, keys)
        return (total >= env.unwrapped.solved) * side(across, jnp)

    sides = jax.vmap(episode)(jax.random.split(key, _COUNTED))
    return jnp.stack([jnp.mean(sides == x) for x in (-1, 1)])


def ways_of_buffer(env: Any, buffer: GoodTrajectories | None) -> np.ndarray:
    """Return the shares of a buffer's episodes, (2,), as `ways_of_policy` does."""
    if buffer is None or not buffer.size:
        return np.full(2, np.nan)
    stored = episodes(buffer, env.unwrapped.episode_length)
    # A discounted return is above 0 where the goal is reached.
    sides = [(x.return_ > 0.0) * side(x.observation[:, 1]) for x in stored]
    return np.array([np.mean(np.array(sides) == x) for x in (-1, 1)])


def count(options: Options, title: str, components: int) -> list[dict[str, Any]]:
    """Train an agent's seeds, and return what is counted of each as a row."""
    env, (name, changes) = gasil_jax.make_env(ENV), AGENTS_OF[title]
    if name == "gail":
        expert = options.runs / "expert.npz"
        if not expert.exists():
            observation, action, _ = demonstrations()
            with output_file.atomic(expert) as partial, partial.open("wb") as file:
                np.savez(file, observation=observation, action=action)
        changes = {**changes, "expert": str(expert)}
    agent = Cloning() if name == Cloning.name else AGENTS[name]()
    algorithm = gasil_jax.Algorithm(agent).replace(
        **changes, total_steps=options.total_steps, policy_components=components
    )
    folder = options.runs / f"{title.replace(', ', '-').replace(' ', '-')}-{components}"
    states = gasil_jax.fit(
        env, algorithm, seeds=options.seeds, folder=folder, resume=True
    ).states
    keys = jax.random.split(jax.random.key(0), options.seeds)
    ways = {
        column: np.asarray(
            jax.jit(
                jax.vmap(
                    functools.partial(ways_of_policy, env, deterministic=deterministic)
                )
            )(states, keys)
        )
        for column, deterministic in zip(_COLUMNS[:2], (False, True), strict=True)
    }
    buffers = jax.device_get(algorithm.agent.good_trajectories(states.agent))
    ways["buffer"] = np.array(
        [
            ways_of_buffer(env, jax.tree.map(lambda x, i=i: x[i], buffers))
            for i in range(options.seeds)
        ]
    )
    return [
        {"agent": title, "policy_components": components, "seed": seed}
        | {
            f"{column} {word}": round(float(ways[column][seed, i]), 4)
            for column in _COLUMNS
            for i, word in enumerate(("left", "right"))
        }
        for seed in range(options.seeds)
    ]


def table(rows: list[dict[str, Any]]) -> str:
    """Return the table of all agents in Markdown.

    A seed solves the maze if nine in ten of its episodes reach the goal, and keeps both
    ways if one in ten takes each.
    """
    head = [
        *("agent", "Gaussians", "seeds", "solve, drawn", "solve, most probable"),
        *("episodes at the goal, drawn", "at the goal, most probable"),
        *("keep both ways, drawn", "buffer has both ways", "buffer has any of both"),
    ]
    table_rows = []
    every = dict.fromkeys((row["agent"], row["policy_components"]) for row in rows)
    for key in every:
        own = [x for x in rows if (x["agent"], x["policy_components"]) == key]
        ways = {
            column: np.array(
                [[x[f"{column} {y}"] for y in ("left", "right")] for x in own]
            )
            for column in _COLUMNS
        }
        reached = [ways[x].sum(axis=1) for x in _COLUMNS[:2]]
        solved = [np.mean(x >= _SOLVED) for x in reached]
        both = [np.mean((ways[x] >= _KEPT).all(axis=1)) for x in ("drawn", "buffer")]
        any_of_both = np.mean((ways["buffer"] > 0.0).all(axis=1))
        numbers = [*solved, *(x.mean() for x in reached), *both, any_of_both]
        cells = [*map(str, (*key, len(own))), *(f"{x:.2f}" for x in numbers)]
        if np.isnan(ways["buffer"]).any():
            cells[-2:] = "-", "-"
        table_rows.append(cells)
    return markdown_table(head, table_rows)


def run(options: Options) -> None:
    """Train all agents, and write two_doors.csv and two_doors.md."""
    command_line.check_minimum(options, seeds=1, total_steps=1)
    titles = options.only or tuple(AGENTS_OF)
    for title in titles:
        if title not in AGENTS_OF:
            raise InputError(unknown("only", title, tuple(AGENTS_OF)))
    output_file.make_parent(options.out / "two_doors.csv")
    options.runs.mkdir(parents=True, exist_ok=True)
    devices.use_devices(Settings(), None, options.seeds)
    rows = [
        row for title in titles for k in COMPONENTS for row in count(options, title, k)
    ]
    with output_file.atomic(options.out / "two_doors.csv") as partial:
        with partial.open("w", newline="") as file:
            writer = csv.DictWriter(file, [*rows[0]], lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    _, _, explained = __doc__.partition("\n\n")
    counted = table(rows)
    text = f"# Two doors\n\n{explained}\n{counted}\n"
    with output_file.atomic(options.out / "two_doors.md") as partial:
        partial.write_text(text)
    print(f"{counted}\nin {options.out / 'two_doors.md'}")
