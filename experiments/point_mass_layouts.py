"""A search for the point mass' layout: ``python -m experiments point_mass_layouts``.

The paper prints no coordinates, so layouts are drawn at random. In each, PPO and
PPO+GASIL are trained with the same learning rates and the same number of runs, with
seeds other than those of the figures; where PPO+GASIL has an alpha more, PPO has as
many seeds more. Layouts, hyperparameters and seeds are all axes of one vmapped program.
Returns go into a CSV file; those in which PPO+GASIL is ahead most clearly are printed.

The environment's own layout comes from 128 layouts (``--count 128 --seeds 2``), and the
sixteen best of them with other seeds (``--layouts 65 103 45 ... --seeds 10 --first-seed
2000``), of which 65 was clearest; the files are in ``results/point_mass_layouts/``.
``--draw`` draws that layout and trains nothing.
"""

import csv
import dataclasses
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import gasil_jax
from experiments import report
from experiments.search import PAIR
from experiments.store import RESULTS
from gasil_envs import wrappers
from gasil_envs.point_mass import Layout, PointMass
from gasil_jax import presets
from gasil_jax.config import Config, Hyperparameters
from gasil_jax.errors import InputError
from gasil_jax.figures import plotting
from gasil_jax.host import command_line, output_file

_MOST_OBJECTS = 12
# Added to the standard error: a lead of less is none, however alike the seeds are.
_MARGIN = 0.2
_COLUMNS = ("layout", "agent", "learning_rate", "alpha", "seed", "early", "final")


@dataclasses.dataclass(frozen=True)
class Options:
    """Train in many layouts and print the best.

    Attributes:
      first: number of the first layout; it decides what is drawn.
      count: how many.
      layouts: these numbers in place of `first` and `count`.
      seeds: of PPO+GASIL at each learning rate and alpha.
      first_seed: number of the first.
      total_steps: of a seed.
      learning_rates: of both agents.
      alphas: of PPO+GASIL.
      discriminator_updates: of PPO+GASIL.
      out: a new CSV file.
      draw: draw the environment's own layout instead.
    """

    first: int = 0
    count: int = 8
    layouts: tuple[int, ...] = ()
    seeds: int = 3
    first_seed: int = 1000
    total_steps: int = 250_000
    learning_rates: tuple[float, ...] = (1e-3, 3e-4, 1e-4)
    alphas: tuple[float, ...] = (0.1, 1.0)
    discriminator_updates: int = 20
    out: pathlib.Path = pathlib.Path("runs", "layouts.csv")
    draw: bool = False


def draw(number: int) -> Layout:
    """Layout `number`: greens and distractors above, blues anywhere, half mirrored."""
    rng = np.random.default_rng(number)
    mirrored = rng.random() < 0.5
    objects: list[tuple[float, float]] = []

    def add(count: int, low: float, high: float) -> tuple[tuple[float, float], ...]:
        before = len(objects)
        while len(objects) < before + count:
            x, y = rng.uniform(-0.9, 0.9), rng.uniform(low, high)
            one_left = count - (len(objects) - before) == 1
            x = 0.0 if mirrored and one_left else x
            new = [(x, y), (-x, y)] if mirrored and not one_left else [(x, y)]
            new = [(round(float(a), 2), round(float(b), 2)) for a, b in new]
            if all(
                max(abs(a - c), abs(b - d)) > 0.2
                for i, (a, b) in enumerate(new)
                for c, d in objects + new[:i]
            ):
                objects.extend(new)
        return tuple(objects[before:])

    return Layout(
        green=add(int(rng.integers(2, 5)), 0.1, 0.9),
        orange=add(int(rng.integers(2, 6)), 0.1, 0.9),
        blue=add(int(rng.integers(0, 4)), -0.9, 0.5),
        start=(0.0, float(rng.choice((0.0, -0.2, -0.4, -0.6)))),
        start_spread=float(rng.choice((0.1, 0.2, 0.4))),
        radius=float(rng.choice((0.08, 0.1, 0.12, 0.15))),
        max_speed=float(rng.choice((0.03, 0.05, 0.07, 0.1))),
        actuation_cost=float(rng.choice((0.02, 0.05, 0.1, 0.2))),
    )


class Arrays(NamedTuple):
    """A layout as arrays: objects (o, 2), their rewards (o,), and its numbers."""

    objects: Any
    rewards: Any
    start: Any
    start_spread: Any
    radius: Any
    max_speed: Any
    actuation_cost: Any


_NUMBERS = Arrays._fields[2:]


def arrays(layout: Layout) -> Arrays:
    """The arrays of a layout; objects that it lacks lie out of reach."""
    env = PointMass(layout)
    objects = np.full((_MOST_OBJECTS, 2), 9.0, np.float32)
    rewards = np.zeros(_MOST_OBJECTS, np.float32)
    objects[: len(env.objects)] = env.objects
    rewards[: len(env.objects)] = env.object_rewards
    numbers = [np.float32(getattr(layout, name)) for name in _NUMBERS]
    return Arrays(objects, rewards, *numbers)


class TracedPointMass(PointMass):
    """The point mass with a layout whose numbers may be traced."""

    def __init__(self, layout: Arrays):
        floats = {name: getattr(layout, name) for name in _NUMBERS[1:]}
        self.layout = Layout(start=(layout.start[0], layout.start[1]), **floats)
        self.objects, self.object_rewards = layout.objects, layout.rewards
        self.episode_length = self.layout.episode_length


def make_returns(config: Config) -> Any:
    """(layout, hyperparameters, seed) -> mean return of each tenth of training (10,).

    A pure function, to be vmapped.
    """

    def returns(
        layout: Arrays, hyperparameters: Hyperparameters, seed: jax.Array
    ) -> jax.Array:
        env = TracedPointMass(layout)
        limited = wrappers.EpisodeLimit(env, env.episode_length)
        train = gasil_jax.make_train(limited, config)
        _, metrics = train(jax.random.key(seed), hyperparameters)
        parts = np.array_split(np.arange(config.num_iterations), 10)
        return jnp.stack([jnp.nanmean(metrics["episode_return"][x]) for x in parts])

    return returns


def _stack(trees: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


def configuration(agent: str, options: Options) -> Config:
    """What an agent's runs have in common."""
    return presets.preset("point_mass", agent, "tuned").replace(
        **{
            "total_steps": options.total_steps,
            "discriminator_updates": options.discriminator_updates,
            # As the layout was found.
            "stagger_episodes": False,
        }
    )


def evaluate(numbers: Sequence[int], options: Options) -> list[dict[str, Any]]:
    """Train both agents in the layouts of these numbers; a row for each run.

    "early" is the mean return over the second tenth of training, "final" over the last.
    """
    rows = []
    for agent in PAIR:
        config = configuration(agent, options)
        program = jax.jit(jax.vmap(make_returns(config)))
        alphas = options.alphas if agent == "ppo+gasil" else (0.0,)
        seeds = options.seeds * len(options.alphas) // len(alphas)
        tuned = config.hyperparameters
        runs: list[dict[str, Any]] = [
            {
                "layout": number,
                "agent": agent,
                "learning_rate": rate,
                "alpha": alpha,
                "seed": options.first_seed + seed,
            }
            for number in numbers
            for rate in options.learning_rates
            for alpha in alphas
            for seed in range(seeds)
        ]
        hyperparameters = [
            tuned.replace(learning_rate=run["learning_rate"], alpha=run["alpha"])
            for run in runs
        ]
        returns = program(
            _stack([arrays(draw(run["layout"])) for run in runs]),
            jax.tree.map(np.float32, _stack(hyperparameters)),
            np.array([run["seed"] for run in runs], np.uint32),
        )
        for run, tenths in zip(runs, np.asarray(returns), strict=True):
            early, final = (round(float(x), 3) for x in (tenths[1], tenths[-1]))
            rows.append(run | {"early": early, "final": final})
    return rows


def rank(rows: Sequence[Mapping[str, Any]]) -> list[tuple[float, str]]:
    """How clearly PPO+GASIL is ahead in each layout, and a line about it, best first.

    Each agent has its best learning rate (and alpha) by the mean final return; the
    figure is the difference of the means over its standard error and `_MARGIN`.
    """
    scores: dict[tuple[int, str], dict[tuple[float, float], list[Any]]] = {}
    for row in rows:
        point = (float(row["learning_rate"]), float(row["alpha"]))
        of_point = scores.setdefault((int(row["layout"]), row["agent"]), {})
        of_point.setdefault(point, []).append(
            (float(row["early"]), float(row["final"]))
        )
    ranked = []
    for number in sorted({layout for layout, _ in scores}):
        best = [
            max(
                scores[number, agent].items(),
                key=lambda item: np.mean([final for _, final in item[1]]),
            )
            for agent in PAIR
        ]
        (ppo_point, _), (point, _) = best
        ppo, gasil = (np.array(values) for _, values in best)
        error = np.sqrt(sum(x[:, 1].var(ddof=1) / len(x) for x in (ppo, gasil)))
        ahead = (gasil[:, 1].mean() - ppo[:, 1].mean()) / (error + _MARGIN)
        line = (
            f"layout {number}: PPO {ppo[:, 0].mean():.1f} early, "
            f"{ppo[:, 1].mean():.1f} final at {ppo_point[0]:g}; PPO+GASIL "
            f"{gasil[:, 0].mean():.1f}, {gasil[:, 1].mean():.1f} at {point[0]:g}, "
            f"alpha {point[1]:g}"
        )
        ranked.append((float(ahead), line))
    return sorted(ranked, reverse=True)


def picture(layout: Layout, path: pathlib.Path) -> None:
    """Save a drawing of the box, the objects with their reach, and the start."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(4.0, 4.0), layout="constrained")
    count = len(layout.blue + layout.green + layout.orange)
    plotting.point_mass_layout(axes, layout, np.zeros(count, bool))
    axes.text(*layout.start, "start", ha="center", va="center", fontsize=9)
    report.save_png(figure, path, dpi=100)


def _check(options: Options) -> None:
    for name in ("learning_rates", "alphas"):
        if not getattr(options, name):
            raise InputError(f"{name} is empty: name one or more")
    if (lowest := min((options.first, *options.layouts))) < 0:
        raise InputError(f"layout is {lowest}: it must be 0 or more")
    command_line.check_least(options, count=1, seeds=2, total_steps=10 * 2048)


def main(arguments: Sequence[str] | None = None) -> int:
    """Evaluate layouts that have not been; returns the exit status."""
    return command_line.exit_status(lambda: _main(arguments))


def _main(arguments: Sequence[str] | None) -> None:
    options = command_line.parse(Options, arguments, "experiments point_mass_layouts")
    _check(options)
    if options.draw:
        picture(Layout(), RESULTS / "point_mass_layout.png")
        return
    output_file.check(options.out, (".csv",))
    output_file.make_parent(options.out)
    jax.config.update("jax_default_matmul_precision", "highest")
    last = options.first + options.count
    rows = evaluate(options.layouts or range(options.first, last), options)
    with output_file.whole(options.out) as partial, partial.open("w") as file:
        writer = csv.DictWriter(file, _COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    for ahead, line in rank(rows)[:20]:
        print(f"{ahead:+.1f} {line}")
    print(f"in {options.out}")
