"""The point mass' layout, and what agents learn there (paper, figures 2, 3 and 4).

One seed of PPO and one of PPO+GASIL are trained. At several moments of training these
are drawn: episodes of the policy, the trajectories in the buffer, and the
discriminator's reward. An arrow shows, of 16 directions at full speed, the action with
the highest reward at a position while no object is collected. The higher the reward,
the more opaque is the arrow.
"""

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import gasil_jax
from experiments import plots
from experiments.store import RESULTS, ResultsFolder
from gasil_envs import pictures
from gasil_jax import normalization, policy
from gasil_jax.agents import PPOGASIL, adversarial
from gasil_jax.host import command_line, output_file
from gasil_jax.networks import Discriminator

_EPISODES = 20
#: The moments, as shares of training; most of the learning is early.
SHARES = (0.0, 0.1, 0.25, 0.5, 1.0)
#: The columns of each agent; PPO has no discriminator.
_COLUMNS = {
    "ppo": ("policy",),
    "ppo+gasil": ("policy", "good trajectories", "discriminator's reward"),
}


@dataclasses.dataclass(frozen=True)
class Options:
    """Draw the point mass, and what PPO and PPO+GASIL learn there.

    Attributes:
      total_steps: environment steps of each agent's seed.
      out: folder of the two pictures, which are replaced.
    """

    total_steps: int = 500_000
    out: ResultsFolder = RESULTS


def states_at(
    env: Any, algorithm: gasil_jax.Algorithm, shares: Sequence[float]
) -> list[Any]:
    """Return the training states of seed 0 at increasing shares of training.

    The first share may be 0, which is after one iteration.
    """

    @functools.partial(jax.jit, donate_argnums=0)
    def advance(state: Any, count: jax.Array) -> Any:
        def step(_: Any, state: Any) -> Any:
            return gasil_jax.train_step(env, algorithm, state)[0]

        return jax.lax.fori_loop(0, count, step, state)

    state, states = gasil_jax.init(env, algorithm, jax.random.key(0)), []
    ends = [max(1, round(share * algorithm.config.num_iterations)) for share in shares]
    for first, end in itertools.pairwise([0, *ends]):
        state = advance(state, end - first)
        states.append(jax.device_get(state))
    return states


def policy_paths(env: Any, state: Any, key: jax.Array) -> np.ndarray:
    """Return positions (episodes, steps + 1, 2) of episodes drawn from the policy."""
    act = policy.from_state(state, env)

    def episode(key: jax.Array) -> jax.Array:
        reset_key, key = jax.random.split(key)
        start = env.reset(reset_key)

        def step(state: Any, key: jax.Array) -> Any:
            state = env.step(state, act(state.obs, key))
            return state, state.pipeline_state.position

        keys = jax.random.split(key, env.unwrapped.episode_length)
        positions = jax.lax.scan(step, start, keys)[1]
        return jnp.concatenate([start.pipeline_state.position[None], positions])

    return np.asarray(jax.jit(jax.vmap(episode))(jax.random.split(key, _EPISODES)))


def buffer_paths(state: Any) -> list[np.ndarray]:
    """Return positions (steps, 2) of each episode in the buffer, the best first."""
    buffer = state.agent.buffer
    size = int(buffer.size)
    starts = np.flatnonzero(np.asarray(buffer.time[:size]) == 0)
    positions = np.asarray(buffer.observation[:size, :2])
    return np.split(positions, starts[1:]) if size else []


def reward_field(
    env: Any, agent: PPOGASIL, state: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions (n, 2), the best direction (n, 2), and its -log D (n,)."""
    line = np.linspace(-0.95, 0.95, 17, dtype=np.float32)
    positions = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    angle = np.arange(16) * (2.0 * np.pi / 16)
    actions = np.stack([np.cos(angle), np.sin(angle)], axis=-1).astype(np.float32)
    objects = np.ones((len(positions), env.observation_size - 2), np.float32)
    observation = normalization.normalize(
        state.normalizer, jnp.asarray(np.concatenate([positions, objects], axis=1))
    )
    network = Discriminator(agent.discriminator_hidden_sizes)
    logits: Any = jax.vmap(
        lambda action: network.apply(
            state.agent.discriminator.params,
            observation,
            jnp.broadcast_to(action, (len(positions), 2)),
        )
    )(jnp.asarray(actions))
    reward = np.asarray(adversarial.softplus_bonus(logits))
    return positions, actions[reward.argmax(axis=0)], reward.max(axis=0)


def draw_moment(panels: Any, env: Any, agent: gasil_jax.Agent, *, state: Any) -> None:
    """Draw an agent's policy, its buffer and, if it has one, its discriminator."""
    for panel in panels:
        none = np.zeros(len(env.unwrapped.objects), bool)
        pictures.point_mass_layout(panel, env.unwrapped.layout, none)
        panel.set(xticks=[], yticks=[])
    for path in policy_paths(env, state, jax.random.key(1)):
        panels[0].plot(*path.T, color="0.2", linewidth=0.7, alpha=0.6)
    if isinstance(agent, PPOGASIL):
        for path in buffer_paths(state):
            panels[1].plot(*path.T, color="#0072B2", linewidth=0.7, alpha=0.6)
        positions, direction, reward = reward_field(env, agent, state)
        strength = (reward - reward.min()) / max(np.ptp(reward), 1e-6)
        panels[2].quiver(
            *positions.T, *direction.T, alpha=strength, scale=28, width=0.006
        )


def run(options: Options) -> None:
    """Draw the layout; train one seed of both agents and draw a row for each moment."""
    command_line.check_minimum(options, total_steps=1)
    path = options.out / "point_mass_moments.png"
    output_file.make_parent(path)
    jax.config.update("jax_default_matmul_precision", "highest")
    env = gasil_jax.make_env("point_mass")
    layout = env.unwrapped.layout
    figure = Figure(figsize=(4.0, 4.0), layout="constrained")
    axes = figure.subplots()
    pictures.point_mass_layout(axes, layout, np.zeros(len(env.unwrapped.objects), bool))
    x, y = layout.start
    axes.text(x, y, "start", ha="center", va="center", fontsize=9)
    plots.save_png(figure, options.out / "point_mass_layout.png", dpi=100)

    titles = [(agent, title) for agent in _COLUMNS for title in _COLUMNS[agent]]
    size = (2.4 * len(titles), 2.5 * len(SHARES))
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(len(SHARES), len(titles), squeeze=False)
    for agent in _COLUMNS:
        algorithm = gasil_jax.preset("point_mass", agent, "tuned")
        algorithm = algorithm.replace(total_steps=options.total_steps)
        columns = [i for i, (of, _) in enumerate(titles) if of == agent]
        for row, state in zip(grid, states_at(env, algorithm, SHARES), strict=True):
            draw_moment(row[columns], env, algorithm.agent, state=state)
            steps = int(state.iteration) * algorithm.config.batch_steps
            row[0].set_ylabel(f"{steps:,} steps")
    for panel, (agent, title) in zip(grid[0], titles, strict=True):
        panel.set_title(f"{agent}: {title}", fontsize=9)
    plots.save_png(figure, path, dpi=75)
    print(f"in {path}")
