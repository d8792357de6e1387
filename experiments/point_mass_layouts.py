"""A search for the point mass' layout: ``python -m experiments.point_mass_layouts``.

The paper prints no coordinates, so layouts are drawn at random. In each, PPO and
PPO+GASIL are trained with the same learning rates and the same number of runs, with
seeds other than those of the figures; where PPO+GASIL has an alpha more, PPO has as
many seeds more. Layouts, hyperparameters and seeds are all axes of one vmapped program:
the places of the objects are traced like any other number. Returns go into a CSV file
for each chunk of layouts; those in which PPO+GASIL is ahead most clearly are printed.

The environment's own layout was found so: 128 layouts (`--count 128 --chunk 128 --seeds
2`), then the sixteen best of them with other seeds (`--layouts 65 103 45 ... --seeds 10
--first-seed 2000`), of which 65 was clearest; the files are in
`results/point_mass_layouts/`.
"""

import csv
import dataclasses
import json
import pathlib
import sys
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import gasil_jax
from experiments.trials import PAIR
from gasil_envs import wrappers
from gasil_envs.point_mass import Layout, PointMass
from gasil_jax import command_line, logging, output_file, presets
from gasil_jax.command_line import InputError
from gasil_jax.config import Config, Hyperparameters

_MOST_OBJECTS = 12
_FIRST_SEED = 1000
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
      chunk: layouts trained at once.
      seeds: of PPO+GASIL at each learning rate and alpha.
      first_seed: number of the first.
      total_steps: of a seed.
      learning_rates: of both agents.
      alphas: of PPO+GASIL.
      discriminator_updates: of PPO+GASIL.
      out: folder of the CSV files, which are not overwritten.
    """

    first: int = 0
    count: int = 8
    layouts: tuple[int, ...] = ()
    chunk: int = 8
    seeds: int = 3
    first_seed: int = _FIRST_SEED
    total_steps: int = 250_000
    learning_rates: tuple[float, ...] = (1e-3, 3e-4, 1e-4)
    alphas: tuple[float, ...] = (0.1, 1.0)
    discriminator_updates: int = 20
    out: pathlib.Path = pathlib.Path("runs", "layouts")


def draw(number: int) -> Layout:
    """Layout `number`: greens and distractors above, blues anywhere, half mirrored."""
    rng = np.random.default_rng(number)
    mirrored = rng.random() < 0.5
    placed: list[tuple[float, float]] = []

    def place(count: int, low: float, high: float) -> tuple[tuple[float, float], ...]:
        before = len(placed)
        while len(placed) < before + count:
            x, y = rng.uniform(-0.9, 0.9), rng.uniform(low, high)
            one_left = count - (len(placed) - before) == 1
            x = 0.0 if mirrored and one_left else x
            new = [(x, y), (-x, y)] if mirrored and not one_left else [(x, y)]
            new = [(round(float(a), 2), round(float(b), 2)) for a, b in new]
            if all(
                max(abs(a - c), abs(b - d)) > 0.2
                for i, (a, b) in enumerate(new)
                for c, d in placed + new[:i]
            ):
                placed.extend(new)
        return tuple(placed[before:])

    return Layout(
        green=place(int(rng.integers(2, 5)), 0.1, 0.9),
        orange=place(int(rng.integers(2, 6)), 0.1, 0.9),
        blue=place(int(rng.integers(0, 4)), -0.9, 0.5),
        start=(0.0, float(rng.choice((0.0, -0.2, -0.4, -0.6)))),
        start_spread=float(rng.choice((0.1, 0.2, 0.4))),
        radius=float(rng.choice((0.08, 0.1, 0.12, 0.15))),
        max_speed=float(rng.choice((0.03, 0.05, 0.07, 0.1))),
        actuation_cost=float(rng.choice((0.02, 0.05, 0.1, 0.2))),
    )


class Places(NamedTuple):
    """A layout as arrays: objects (o, 2), their rewards (o,), and its numbers."""

    objects: Any
    rewards: Any
    start: Any
    start_spread: Any
    radius: Any
    max_speed: Any
    actuation_cost: Any


def places(layout: Layout) -> Places:
    """The arrays of a layout; objects that it lacks lie out of reach."""
    env = PointMass(layout)
    objects = np.full((_MOST_OBJECTS, 2), 9.0, np.float32)
    rewards = np.zeros(_MOST_OBJECTS, np.float32)
    objects[: len(env.objects)] = env.objects
    rewards[: len(env.objects)] = env.object_rewards
    floats = ("start", "start_spread", "radius", "max_speed", "actuation_cost")
    return Places(
        objects, rewards, *(np.float32(getattr(layout, name)) for name in floats)
    )


class TracedPointMass(PointMass):
    """The point mass with a layout whose numbers may be traced."""

    def __init__(self, where: Places):
        names = ("start_spread", "radius", "max_speed", "actuation_cost")
        self.layout = Layout(
            start=(where.start[0], where.start[1]),
            **{name: getattr(where, name) for name in names},
        )
        self.objects, self.object_rewards = where.objects, where.rewards
        self.episode_length = self.layout.episode_length


def make_returns(config: Config) -> Any:
    """(places, hyperparameters, seed) -> mean return of each tenth of training (10,).

    A pure function, to be vmapped.
    """

    def returns(
        where: Places, hyperparameters: Hyperparameters, seed: jax.Array
    ) -> jax.Array:
        env = TracedPointMass(where)
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
        }
    )


def evaluate(
    numbers: Sequence[int], options: Options, programs: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """Train both agents in some layouts; a row for each run.

    "early" is the mean return over the second tenth of training, "final" over the last.

    Args:
      numbers: of the layouts.
      options: what to train.
      programs: of each agent, vmapped `make_returns`.
    """
    rows = []
    for agent, program in programs.items():
        alphas = options.alphas if agent == "ppo+gasil" else (0.0,)
        seeds = options.seeds * len(options.alphas) // len(alphas)
        tuned = configuration(agent, options).hyperparameters
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
            _stack([places(draw(run["layout"])) for run in runs]),
            jax.tree.map(np.float32, _stack(hyperparameters)),
            np.array([run["seed"] for run in runs], np.uint32),
        )
        for run, tenths in zip(runs, np.asarray(returns), strict=True):
            early, final = (round(float(x), 3) for x in (tenths[1], tenths[-1]))
            rows.append(run | {"early": early, "final": final})
    return rows


def rank(rows: Sequence[dict[str, Any]]) -> list[tuple[float, str]]:
    """How clearly PPO+GASIL is ahead in each layout, and a line about it, best first.

    Each agent has its best learning rate (and alpha) by the mean final return; the
    figure is the difference of the means over its standard error and `_MARGIN`.
    """
    found = []
    for number in sorted({int(row["layout"]) for row in rows}):
        best = {}
        for agent in PAIR:
            by_point: dict[tuple[float, float], list[tuple[float, float]]] = {}
            for row in rows:
                if int(row["layout"]) == number and row["agent"] == agent:
                    point = (float(row["learning_rate"]), float(row["alpha"]))
                    scores = (float(row["early"]), float(row["final"]))
                    by_point.setdefault(point, []).append(scores)
            chosen, all_scores = max(
                by_point.items(), key=lambda item: np.mean([x[1] for x in item[1]])
            )
            best[agent] = (chosen, np.array(all_scores))
        (ppo_point, ppo), (point, gasil) = (best[agent] for agent in PAIR)
        error = np.sqrt(sum(x[:, 1].var(ddof=1) / len(x) for x in (ppo, gasil)))
        ahead = (gasil[:, 1].mean() - ppo[:, 1].mean()) / (error + _MARGIN)
        said = (
            f"layout {number}: PPO {ppo[:, 0].mean():.1f} early, "
            f"{ppo[:, 1].mean():.1f} final at {ppo_point[0]:g}; PPO+GASIL "
            f"{gasil[:, 0].mean():.1f}, {gasil[:, 1].mean():.1f} at {point[0]:g}, "
            f"alpha {point[1]:g}"
        )
        found.append((float(ahead), said))
    return sorted(found, reverse=True)


def _check(options: Options) -> None:
    for name in ("learning_rates", "alphas"):
        if not getattr(options, name):
            raise InputError(f"{name} is empty: name one or more")
    if (lowest := min((options.first, *options.layouts))) < 0:
        raise InputError(f"layout is {lowest}: it must be 0 or more")
    command_line.check_least(options, count=1, chunk=1, seeds=2, total_steps=10 * 2048)


def main(arguments: Sequence[str] | None = None) -> int:
    """Evaluate layouts that have not been; returns the exit status."""
    return command_line.exit_status(lambda: _main(arguments))


def _main(arguments: Sequence[str] | None) -> None:
    options = command_line.parse(Options, arguments, "experiments.point_mass_layouts")
    _check(options)
    jax.config.update("jax_default_matmul_precision", "highest")
    numbers = options.layouts or tuple(
        range(options.first, options.first + options.count)
    )
    options.out.mkdir(parents=True, exist_ok=True)
    described = options.out / "options.json"
    wanted = dataclasses.asdict(options) | {"layouts": numbers, "out": None}
    wanted = json.loads(json.dumps(wanted))
    if not described.exists():
        logging.write_json(described, wanted)
    elif json.loads(described.read_text()) != wanted:
        raise InputError(f"out is {options.out}, which is of other options")
    programs = {
        agent: jax.jit(jax.vmap(make_returns(configuration(agent, options))))
        for agent in PAIR
    }
    rows: list[dict[str, Any]] = []
    for begin in range(0, len(numbers), options.chunk):
        chunk = numbers[begin : begin + options.chunk]
        path = options.out / f"{chunk[0]}-{chunk[-1]}.csv"
        if not path.exists():
            new = evaluate(chunk, options, programs)
            # Whole or not: what is there counts as done.
            with (
                output_file.whole(path) as partial,
                partial.open("w", newline="") as file,
            ):
                writer = csv.DictWriter(file, _COLUMNS, lineterminator="\n")
                writer.writeheader()
                writer.writerows(new)
        with path.open(newline="") as file:
            rows += csv.DictReader(file)
        print(path, flush=True)
    for ahead, said in rank(rows)[:20]:
        print(f"{ahead:+.1f} {said}")


if __name__ == "__main__":
    sys.exit(main())
