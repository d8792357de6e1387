"""The random layouts among which the point mass' layout was chosen.

The paper prints no coordinates, so PPO and PPO+GASIL were trained in layouts 0 to 127,
which are drawn at random, and then with new seeds in sixteen of the eighteen in which
PPO+GASIL was most clearly ahead. The environment's layout is number 65. Both agents had
the same learning rates and the same number of runs: PPO+GASIL had two alphas, and PPO
twice the seeds. The returns of all runs are in ``results/point_mass_layouts``.

Any layout is an environment for ``gasil_jax.run`` and ``gasil_jax.sweep``, such as
``--env experiments.point_mass_layouts:layout_65``.
"""

import csv
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from experiments.search import PAIR
from experiments.store import RESULTS
from gasil_envs.point_mass import Layout, PointMass

# Added to the standard error, so that a small lead does not count even if all seeds
# have almost the same return.
_MARGIN = 0.2


@dataclasses.dataclass(frozen=True)
class Options:
    """Rank the point mass' random layouts by how clearly PPO+GASIL is ahead.

    Attributes:
      count: number of layouts to print, of all and of those with new seeds.
    """

    count: int = 16


def draw(number: int) -> Layout:
    """Draw layout `number`.

    Green objects and distractors are in the upper half, blue ones anywhere but at the
    top, and half of the layouts are mirror-symmetric.
    """
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


def __getattr__(name: str) -> Callable[[], PointMass]:
    """Return the function that builds the environment layout_NUMBER."""
    word, _, number = name.partition("_")
    if word != "layout" or not number.isdecimal():
        raise AttributeError(f"{name!r} must be layout_NUMBER")
    return lambda: PointMass(draw(int(number)))


def rank(rows: Sequence[Mapping[str, Any]]) -> list[tuple[float, str]]:
    """Return each layout's lead of PPO+GASIL, with a line about it, best first.

    Each agent has its best learning rate (and alpha) by the mean final return. The lead
    is the difference of the means divided by its standard error plus `_MARGIN`.

    Args:
      rows: a row for each run, with its mean return over the second tenth of training,
        "early", and over the last one, "final".
    """
    scores: dict[tuple[int, str], dict[tuple[float, float], list[Any]]] = {}
    for row in rows:
        point = (float(row["learning_rate"]), float(row["alpha"]))
        of_point = scores.setdefault((int(row["layout"]), row["agent"]), {})
        returns = (float(row["early"]), float(row["final"]))
        of_point.setdefault(point, []).append(returns)

    def final_mean(item: Any) -> Any:
        return np.mean([final for _, final in item[1]])

    ranked = []
    for number in sorted({layout for layout, _ in scores}):
        best = [max(scores[number, agent].items(), key=final_mean) for agent in PAIR]
        (ppo_rate, _), (gasil_rate, alpha) = (point for point, _ in best)
        ppo, gasil = (np.array(returns) for _, returns in best)
        error = np.sqrt(sum(x[:, 1].var(ddof=1) / len(x) for x in (ppo, gasil)))
        lead = (gasil[:, 1].mean() - ppo[:, 1].mean()) / (error + _MARGIN)
        line = (
            f"layout {number}: PPO {ppo[:, 0].mean():.1f} early, "
            f"{ppo[:, 1].mean():.1f} final at {ppo_rate:g}; PPO+GASIL "
            f"{gasil[:, 0].mean():.1f}, {gasil[:, 1].mean():.1f} at {gasil_rate:g}, "
            f"alpha {alpha:g}"
        )
        ranked.append((float(lead), line))
    return sorted(ranked, reverse=True)


def leads(name: str = "0-127.csv") -> list[tuple[float, str]]:
    """Return the stored layouts as `rank` does."""
    with (RESULTS / "point_mass_layouts" / name).open(newline="") as file:
        return rank(list(csv.DictReader(file)))


def run(options: Options) -> None:
    """Print the best layouts."""
    for name in ("0-127.csv", "65-117.csv"):
        ranked = leads(name)
        print(f"{name}: lead of PPO+GASIL in {len(ranked)} layouts")
        for lead, line in ranked[: options.count]:
            print(f"{lead:+.1f} {line}")
