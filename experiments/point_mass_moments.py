"""What is learned on the point mass (paper, figures 3 and 4).

``python -m experiments point_mass_moments`` trains one seed of PPO and of PPO+GASIL and
draws them at several moments of training: episodes of the policy, the trajectories in
the buffer, and the discriminator's reward. An arrow is the action that the
discriminator pays most at a place, of 16 directions at full speed, with every object
still there; the stronger its colour the higher the reward. ``--animate`` makes a film.
"""

import dataclasses
import itertools
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

import gasil_jax
from experiments import report
from experiments.figures import FIGURES
from experiments.store import RESULTS, Store
from gasil_jax import normalization, policy
from gasil_jax.figures import plotting
from gasil_jax.host import command_line, output_file
from gasil_jax.host.members import make_members, member
from gasil_jax.imitation import adversarial
from gasil_jax.networks import Discriminator

_EPISODES = 20
#: Shares of training: more of the early ones, most happens there.
SHARES = (0.0, 0.1, 0.25, 0.5, 1.0)
#: An agent's columns; PPO has no discriminator.
_COLUMNS = {
    "ppo": ("policy", "good trajectories"),
    "ppo+gasil": ("policy", "good trajectories", "discriminator's reward"),
}
#: Agent -> its configuration and its states, one for each moment.
Moments = Mapping[str, tuple[gasil_jax.Config, Sequence[Any]]]


@dataclasses.dataclass(frozen=True)
class Options:
    """Train one seed of PPO and of PPO+GASIL and draw what they learn.

    Attributes:
      total_steps: of the seed.
      animate: make a film of so many frames instead.
      out: folder of the picture or film, which is made anew.
    """

    total_steps: int = 500_000
    animate: int = 0
    out: pathlib.Path = RESULTS


def train(env: Any, config: gasil_jax.Config, moments: Sequence[float]) -> list[Any]:
    """The state of seed 0 at `moments`, in shares of training, increasing from 0."""
    members = make_members(env, config, [0])
    states, advance = members.compile()
    ends = [max(1, round(share * config.num_iterations)) for share in moments]
    kept = []
    for first, end in itertools.pairwise([0, *ends]):
        for done in range(first, end, members.chunk):
            count = min(members.chunk, end - done)
            states, _ = members.train(advance, states, done, count)
        kept.append(jax.device_get(member(members.trim(states), 0)))
    return kept


def policy_paths(env: Any, state: Any, key: jax.Array) -> np.ndarray:
    """Positions (episodes, steps + 1, 2) of episodes drawn from the policy."""
    act = policy.from_state(state, env)

    def one(key: jax.Array) -> jax.Array:
        reset_key, key = jax.random.split(key)
        start = env.reset(reset_key)

        def step(state: Any, key: jax.Array) -> Any:
            state = env.step(state, act(state.obs, key))
            return state, state.pipeline_state.position

        keys = jax.random.split(key, env.unwrapped.episode_length)
        positions = jax.lax.scan(step, start, keys)[1]
        return jnp.concatenate([start.pipeline_state.position[None], positions])

    return np.asarray(jax.jit(jax.vmap(one))(jax.random.split(key, _EPISODES)))


def buffer_paths(state: Any) -> list[np.ndarray]:
    """Positions (steps, 2) of each episode in the buffer, the best first."""
    buffer = state.good_trajectories
    size = int(buffer.size)
    starts = np.flatnonzero(np.asarray(buffer.time[:size]) == 0)
    positions = np.asarray(buffer.observation[:size, :2])
    return np.split(positions, starts[1:]) if size else []


def reward_field(
    env: Any, config: gasil_jax.Config, state: Any, num_lines: int = 17
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions (n, 2), the best direction there (n, 2), and its -log D (n,)."""
    line = np.linspace(-0.95, 0.95, num_lines, dtype=np.float32)
    positions = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    angle = np.arange(16) * (2.0 * np.pi / 16)
    actions = np.stack([np.cos(angle), np.sin(angle)], axis=-1).astype(np.float32)
    objects = np.ones((len(positions), env.observation_size - 2), np.float32)
    observation = normalization.normalize(
        state.normalizer, jnp.asarray(np.concatenate([positions, objects], axis=1))
    )
    network = Discriminator(config.discriminator_hidden_sizes)
    logits: Any = jax.vmap(
        lambda action: network.apply(
            state.imitation.params,
            observation,
            jnp.broadcast_to(action, (len(positions), 2)),
        )
    )(jnp.asarray(actions))
    reward = np.asarray(adversarial.bonus(logits, jnp.float32(1.0)))
    return positions, actions[reward.argmax(axis=0)], reward.max(axis=0)


def draw_moment(panels: Any, env: Any, config: gasil_jax.Config, state: Any) -> None:
    """One moment of an agent: its policy, its buffer, and its discriminator if any."""
    for panel in panels:
        panel.clear()
        none = np.zeros(len(env.unwrapped.objects), bool)
        plotting.point_mass_layout(panel, env.unwrapped.layout, none)
        panel.set(xticks=[], yticks=[])
    for path in policy_paths(env, state, jax.random.key(1)):
        panels[0].plot(*path.T, color="0.2", linewidth=0.7, alpha=0.6)
    for path in buffer_paths(state):
        panels[1].plot(*path.T, color="#0072B2", linewidth=0.7, alpha=0.6)
    if len(panels) > 2:
        positions, direction, reward = reward_field(env, config, state)
        strength = (reward - reward.min()) / max(np.ptp(reward), 1e-6)
        panels[2].quiver(
            *positions.T, *direction.T, alpha=strength, scale=28, width=0.006
        )


def _draw_row(panels: Any, env: Any, moments: Moments, number: int) -> str:
    """Every agent at one moment; returns how far training is."""
    steps = 0
    for agent, (config, states) in moments.items():
        mine, panels = np.split(panels, [len(_COLUMNS[agent])])
        draw_moment(mine, env, config, states[number])
        steps = int(states[number].iteration) * config.batch_steps
    return f"{steps:,} steps"


def _titles(panels: Sequence[Any], moments: Moments) -> None:
    titles = [f"{agent}: {name}" for agent in moments for name in _COLUMNS[agent]]
    for panel, title in zip(panels, titles, strict=True):
        panel.set_title(title, fontsize=9)


def draw(env: Any, moments: Moments, path: pathlib.Path, animate: int) -> None:
    """Figures 3 and 4 side by side: a row for each moment, or a frame of a film."""
    import matplotlib.pyplot as plt
    from matplotlib.animation import FuncAnimation, PillowWriter

    columns = sum(len(_COLUMNS[agent]) for agent in moments)
    rows = 1 if animate else len(SHARES)
    size = (2.4 * columns, 3.0 if animate else 2.5 * rows)
    figure, grid = plt.subplots(
        rows, columns, figsize=size, layout="constrained", squeeze=False
    )
    if not animate:
        for number, row in enumerate(grid):
            row[0].set_ylabel(_draw_row(row, env, moments, number))
        _titles(grid[0], moments)
        report.save_png(figure, path, dpi=75)
        return

    def frame(number: int) -> None:
        figure.suptitle(_draw_row(grid[0], env, moments, number))
        _titles(grid[0], moments)

    film = FuncAnimation(figure, frame, frames=animate)
    film.save(path, writer=PillowWriter(fps=2), dpi=80)
    plt.close(figure)


def config(agent: str) -> gasil_jax.Config:
    """What the figure's runs of an agent are trained with."""
    curve = FIGURES["point_mass"].panels["point_mass"][agent]
    return curve.runs(Store(RESULTS / "runs"))[0].config


def main(arguments: Sequence[str] | None = None) -> int:
    """Train one seed of both agents and draw; returns the exit status."""
    return command_line.exit_status(lambda: _main(arguments))


def _main(arguments: Sequence[str] | None) -> None:
    options = command_line.parse(Options, arguments, "experiments point_mass_moments")
    command_line.check_least(options, total_steps=1, animate=0)
    name = "point_mass.gif" if options.animate else "point_mass_moments.png"
    path = options.out / name
    output_file.make_parent(path)
    jax.config.update("jax_default_matmul_precision", "highest")
    matplotlib.use("Agg")
    env = gasil_jax.make_env("point_mass")
    shares = np.linspace(0, 1, options.animate).tolist() or SHARES
    moments = {}
    for agent in _COLUMNS:
        own = config(agent).replace(total_steps=options.total_steps)
        moments[agent] = own, train(env, own, shares)
    draw(env, moments, path, options.animate)
    print(f"in {path}")
