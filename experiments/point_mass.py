"""The 2D point mass (paper, section 5.2): ``python -m experiments.point_mass``.

PPO against PPO+GASIL, the tuned presets (figure 2), and one seed of PPO+GASIL at
several moments of training (figures 3 and 4): episodes of the policy, the trajectories
in the buffer, and the discriminator's reward. An arrow is the action that the
discriminator pays most at a place, of 16 directions at full speed, with every object
still there; the stronger its colour the higher the reward. ``--animate`` makes a film.

Ten seeds of 500,000 steps take some 4 minutes on two CPU cores.
"""

import argparse
import itertools
import pathlib
import sys
import time
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

import gasil_jax
from gasil_jax import (
    batch,
    normalization,
    plotting,
    policy,
    presets,
    statistics,
)
from gasil_jax.environments import available_cores
from gasil_jax.imitation import adversarial
from gasil_jax.networks import Discriminator

AGENTS = ("ppo", "ppo+gasil")
FIGURES = pathlib.Path(__file__).parent / "figures"
_EPISODES = 20


def train(
    env: Any, agent: str, seeds: int, total_steps: int, num_moments: int
) -> tuple[gasil_jax.Config, dict[str, np.ndarray], list[Any]]:
    """Train all seeds.

    Returns:
      the configuration; metrics, (seeds, iterations) each; and the first seed's state
      at so many moments, evenly spaced and the last at the end.
    """
    config = presets.preset("point_mass", agent, "tuned").replace(
        total_steps=total_steps
    )
    runs = batch.make_batch(env, config, range(seeds))
    states, advance = runs.compile()
    ends = np.linspace(0, config.num_iterations, num_moments + 1).astype(int)
    history, moments = [], []
    for first, end in itertools.pairwise(ends.tolist()):
        for done in range(first, end, runs.chunk):
            count = min(runs.chunk, end - done)
            states, metrics = runs.train(advance, states, done, count)
            history.append(metrics)
        moments.append(jax.device_get(batch.member(runs.trim(states), 0)))
    joined = {
        name: np.concatenate([metrics[name] for metrics in history], axis=1)
        for name in history[0]
    }
    return config, joined, moments


def draw_curves(
    curves: dict[str, dict[str, np.ndarray]], path: pathlib.Path
) -> dict[str, tuple[float, float, float]]:
    """Figure 2; returns each agent's final interquartile mean and its interval."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.0, 3.6), layout="constrained")
    final = {}
    for (agent, metrics), color in zip(curves.items(), ("0.4", "#0072B2"), strict=True):
        returns = metrics["episode_return"]
        window = max(1, returns.shape[1] // 50)
        smooth = plotting.smooth(returns, window)[:, window - 1 :: window]
        steps = metrics["env_steps"][0][window - 1 :: window]
        low, high = statistics.bootstrap_interval(smooth)
        axes.fill_between(steps, low, high, color=color, alpha=0.2, linewidth=0)
        middle = statistics.interquartile_mean(smooth, axis=0)
        axes.plot(steps, middle, color=color, label=agent.upper())
        last = np.nanmean(returns[:, -max(1, returns.shape[1] // 10) :], axis=1)
        interval = statistics.bootstrap_interval(last)
        middle = float(statistics.interquartile_mean(last))
        final[agent] = (middle, float(interval[0]), float(interval[1]))
    axes.set(xlabel="environment steps", ylabel="episode return")
    axes.legend(frameon=False, loc="lower right")
    plotting.save(figure, path, dpi=130)
    return final


def policy_paths(env: Any, state: Any, key: jax.Array) -> np.ndarray:
    """Places (episodes, steps + 1, 2) of episodes drawn from the policy."""
    act = policy.from_state(state, env)

    def one(key: jax.Array) -> jax.Array:
        reset_key, key = jax.random.split(key)
        start = env.reset(reset_key)

        def step(state: Any, key: jax.Array) -> Any:
            state = env.step(state, act(state.obs, key))
            return state, state.pipeline_state.position

        keys = jax.random.split(key, env.unwrapped.episode_length)
        places = jax.lax.scan(step, start, keys)[1]
        return jnp.concatenate([start.pipeline_state.position[None], places])

    return np.asarray(jax.jit(jax.vmap(one))(jax.random.split(key, _EPISODES)))


def buffer_paths(state: Any) -> list[np.ndarray]:
    """Places (steps, 2) of each episode in the buffer, the best first."""
    buffer = state.good_trajectories
    size = int(buffer.size)
    starts = np.flatnonzero(np.asarray(buffer.time[:size]) == 0)
    places = np.asarray(buffer.observation[:size, :2])
    return np.split(places, starts[1:]) if size else []


def reward_field(
    env: Any, config: gasil_jax.Config, state: Any, num_places: int = 17
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places (n, 2), the best direction there (n, 2), and its -log D (n,)."""
    line = np.linspace(-0.95, 0.95, num_places, dtype=np.float32)
    places = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    angle = np.arange(16) * (2.0 * np.pi / 16)
    actions = np.stack([np.cos(angle), np.sin(angle)], axis=-1).astype(np.float32)
    there = np.ones((len(places), env.observation_size - 2), np.float32)
    observation = normalization.normalize(
        state.normalizer, jnp.asarray(np.concatenate([places, there], axis=1))
    )
    network = Discriminator(config.discriminator_hidden_sizes)
    logit = jax.vmap(
        lambda action: network.apply(
            state.imitation.params,
            observation,
            jnp.broadcast_to(action, (len(places), 2)),
        )
    )(jnp.asarray(actions))
    reward = np.asarray(adversarial.bonus(logit, jnp.float32(1.0)))
    return places, actions[reward.argmax(axis=0)], reward.max(axis=0)


_COLUMNS = ("policy", "good trajectories", "discriminator's reward")


def draw_moment(
    panels: Sequence[Any], env: Any, config: gasil_jax.Config, state: Any
) -> None:
    """The three pictures of one moment, side by side."""
    layout = env.unwrapped.layout
    for panel in panels:
        panel.clear()
        none = np.zeros(len(env.unwrapped.objects), bool)
        plotting.point_mass_layout(panel, layout, none)
        panel.set(xticks=[], yticks=[])
    for path in policy_paths(env, state, jax.random.key(1)):
        panels[0].plot(*path.T, color="0.2", linewidth=0.7, alpha=0.6)
    for path in buffer_paths(state):
        panels[1].plot(*path.T, color="#0072B2", linewidth=0.7, alpha=0.6)
    places, direction, reward = reward_field(env, config, state)
    strength = (reward - reward.min()) / max(np.ptp(reward), 1e-6)
    panels[2].quiver(
        *places.T, *direction.T, alpha=strength, scale=28, width=0.006, color="black"
    )


def draw_moments(
    env: Any, config: gasil_jax.Config, moments: Sequence[Any], path: pathlib.Path
) -> None:
    """Figures 3 and 4: a row for each moment."""
    import matplotlib.pyplot as plt

    size = (7.5, 2.5 * len(moments))
    figure, rows = plt.subplots(len(moments), 3, figsize=size, layout="constrained")
    for row, state in zip(rows, moments, strict=True):
        draw_moment(row, env, config, state)
        steps = int(state.iteration) * config.batch_steps
        row[0].set_ylabel(f"{steps:,} steps")
    for panel, title in zip(rows[0], _COLUMNS, strict=True):
        panel.set_title(title, fontsize=10)
    plotting.save(figure, path, dpi=90)


def animate(
    env: Any, config: gasil_jax.Config, moments: Sequence[Any], path: pathlib.Path
) -> None:
    """The same as a film, a frame for each moment."""
    import matplotlib.pyplot as plt
    from matplotlib.animation import FuncAnimation, PillowWriter

    figure, panels = plt.subplots(1, 3, figsize=(9.0, 3.3), layout="constrained")

    def frame(number: int) -> None:
        state = moments[number]
        draw_moment(panels, env, config, state)
        steps = int(state.iteration) * config.batch_steps
        figure.suptitle(f"{steps:,} steps")
        for panel, title in zip(panels, _COLUMNS, strict=True):
            panel.set_title(title, fontsize=10)

    film = FuncAnimation(figure, frame, frames=len(moments))
    film.save(path, writer=PillowWriter(fps=2), dpi=80)
    plt.close(figure)


def main(arguments: Sequence[str] | None = None) -> int:
    """Train both agents and draw; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--total-steps", type=int, default=500_000)
    parser.add_argument("--moments", type=int, default=24, help="of the film")
    parser.add_argument("--animate", action="store_true")
    parser.add_argument("--out", type=pathlib.Path, default=FIGURES)
    options = parser.parse_args(arguments)
    if options.seeds < 1 or options.total_steps < 1 or options.moments < 5:
        print(
            "error: seeds and total-steps must be 1 or more, moments 5 or more",
            file=sys.stderr,
        )
        return 2
    jax.config.update("jax_num_cpu_devices", min(available_cores(), options.seeds))
    jax.config.update("jax_default_matmul_precision", "highest")
    matplotlib.use("Agg")
    env = gasil_jax.make_env("point_mass")
    curves = {}
    for agent in AGENTS:
        began = time.monotonic()
        asked = (options.seeds, options.total_steps, options.moments)
        config, curves[agent], moments = train(env, agent, *asked)
        print(f"{agent}: {time.monotonic() - began:.0f} s", flush=True)
    final = draw_curves(curves, options.out / "point_mass_curves.png")
    for agent, (middle, low, high) in final.items():
        print(f"{agent:10} final return {middle:.1f}, 95% from {low:.1f} to {high:.1f}")
    # More of the early ones: most happens there.
    places = np.unique(np.array([0.0, 0.1, 0.25, 0.5, 1.0]) * (len(moments) - 1))
    few = [moments[int(i)] for i in places]
    draw_moments(env, config, few, options.out / "point_mass_moments.png")
    if options.animate:
        animate(env, config, moments, options.out / "point_mass.gif")
    print(f"in {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
