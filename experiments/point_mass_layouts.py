"""A search for the point mass' layout: ``python -m experiments.point_mass_layouts``.

The paper prints no coordinates. Layouts are drawn from two families: a blue object or
two below the start, greens above, and between them a row of orange distractors; and
greens on two sides with distractors between and beyond. In each, PPO and PPO+GASIL are
trained at the same learning rates with the same seeds, other than those of the figures,
and each layout's returns go into a CSV file.
"""

import argparse
import csv
import pathlib
import sys
from collections.abc import Sequence

import jax
import numpy as np

from experiments import point_mass
from gasil_envs import wrappers
from gasil_envs.point_mass import Layout, PointMass
from gasil_jax import batch, presets
from gasil_jax.environments import available_cores

LEARNING_RATES = (1e-3, 3e-4, 1e-4)
_FIRST_SEED = 1000


Places = tuple[tuple[float, float], ...]


def _row(count: int, spacing: float, y: float) -> Places:
    """Places in a row, centred."""
    first = -spacing * (count - 1) / 2
    return tuple(
        (round(float(first + i * spacing), 3), round(float(y), 3)) for i in range(count)
    )


def draw(number: int) -> Layout:
    """Layout `number`: below 1000 greens behind distractors, then on two sides."""
    rng = np.random.default_rng(number)
    return _behind(rng) if number < 1000 else _two_sides(rng)


def _behind(rng: np.random.Generator) -> Layout:
    barrier = rng.choice((0.3, 0.35, 0.4, 0.45))
    return Layout(
        blue=_row(rng.choice((1, 1, 2)), 0.6, -rng.choice((0.3, 0.4, 0.5))),
        green=_row(
            rng.choice((2, 3, 4)),
            rng.choice((0.3, 0.4)),
            barrier + rng.choice((0.25, 0.35, 0.45)),
        ),
        orange=_row(rng.choice((3, 5, 7)), rng.choice((0.2, 0.25, 0.3)), barrier),
        start_spread=float(rng.choice((0.1, 0.2))),
        radius=float(rng.choice((0.1, 0.12, 0.15))),
        max_speed=float(rng.choice((0.05, 0.07, 0.1))),
        actuation_cost=float(rng.choice((0.02, 0.05, 0.1))),
    )


def _two_sides(rng: np.random.Generator) -> Layout:
    x, y = rng.choice((0.3, 0.4, 0.5)), rng.choice((0.1, 0.3, 0.5))
    wall = int(rng.choice((1, 3)))
    low = rng.choice((-0.6, -0.7))
    blue = ((-0.5, low), (0.5, low))
    green = ((-x, y), (x, y), *(((0.0, y + 0.4),) if rng.random() < 0.5 else ()))
    return Layout(
        blue=blue[: int(rng.choice((0, 1, 2)))],
        green=tuple((round(float(a), 3), round(float(b), 3)) for a, b in green),
        orange=(
            *((0.0, round(float(y + 0.2 * (i - wall // 2)), 3)) for i in range(wall)),
            *((side, float(y)) for side in (-0.75, 0.75)),
        ),
        start=(0.0, -0.3),
        start_spread=float(rng.choice((0.2, 0.3, 0.4))),
        radius=float(rng.choice((0.1, 0.12, 0.15))),
        max_speed=float(rng.choice((0.05, 0.1))),
        actuation_cost=float(rng.choice((0.02, 0.05, 0.1, 0.2))),
    )


def evaluate(
    layout: Layout, seeds: int, total_steps: int, alpha: float
) -> list[dict[str, object]]:
    """Train both agents; a row for each agent, learning rate and seed.

    "early" is the mean return over the second tenth of training, "final" over the last.
    """
    env = wrappers.EpisodeLimit(PointMass(layout), layout.episode_length)
    rows = []
    for agent in point_mass.AGENTS:
        config = presets.preset("point_mass", agent, "tuned").updated(
            {"total_steps": total_steps, "alpha": alpha}
        )
        numbers = list(range(_FIRST_SEED, _FIRST_SEED + seeds))
        hyperparameters = [
            config.hyperparameters.replace(learning_rate=rate)
            for rate in LEARNING_RATES
            for _ in numbers
        ]
        runs = batch.make_batch(
            env, config, numbers * len(LEARNING_RATES), hyperparameters
        )
        states, advance = runs.compile()
        returns = []
        for done in range(0, config.num_iterations, runs.chunk):
            count = min(runs.chunk, config.num_iterations - done)
            states, metrics = runs.train(advance, states, done, count)
            returns.append(metrics["episode_return"])
        tenths = np.array_split(np.concatenate(returns, axis=1), 10, axis=1)
        for member, (early, final) in enumerate(zip(tenths[1], tenths[-1])):
            rows.append(
                {
                    "agent": agent,
                    "learning_rate": LEARNING_RATES[member // seeds],
                    "seed": numbers[member % seeds],
                    "early": round(float(np.nanmean(early)), 3),
                    "final": round(float(np.nanmean(final)), 3),
                }
            )
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    """Evaluate layouts that have not been; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--total-steps", type=int, default=250_000)
    parser.add_argument("--alpha", type=float, default=1.0, help="of PPO+GASIL")
    parser.add_argument(
        "--runs", type=pathlib.Path, default=pathlib.Path("runs", "layouts")
    )
    options = parser.parse_args(arguments)
    jax.config.update("jax_num_cpu_devices", available_cores())
    jax.config.update("jax_default_matmul_precision", "highest")
    options.runs.mkdir(parents=True, exist_ok=True)
    for number in range(options.first, options.first + options.count):
        path = options.runs / f"{number}.csv"
        if path.exists():
            continue
        rows = evaluate(draw(number), options.seeds, options.total_steps, options.alpha)
        with path.open("x", newline="") as file:
            writer = csv.DictWriter(file, ["layout", *rows[0]], lineterminator="\n")
            writer.writeheader()
            writer.writerows({"layout": number, **row} for row in rows)
        print(path, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
