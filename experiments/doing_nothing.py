"""What doing nothing returns: zero actions on the tasks of the paper's own protocol.

Doing nothing until the time limit may return more than what an agent has learned. The
returns are in ``results/doing_nothing.csv``: the mean over a hundred episodes and its
95% interval, of two standard errors, measured by the code of commit ecc235d. A delayed
reward has the same sum over an episode.
"""

import csv
import functools
from collections.abc import Mapping
from typing import NamedTuple

from experiments.curves import Figure
from experiments.store import RESULTS


class Return(NamedTuple):
    """The mean return of episodes, and the ends of its interval."""

    mean: float
    low: float
    high: float


@functools.cache
def stored() -> Mapping[str, Return]:
    """Return what is in doing_nothing.csv, by task."""
    with (RESULTS / "doing_nothing.csv").open(newline="") as file:
        return {
            row["task"]: Return(*(float(row[x]) for x in Return._fields))
            for row in csv.DictReader(file)
        }


def of(figure: Figure, panel: str) -> Return | None:
    """Return what doing nothing returns in a panel, or None if it is not shown."""
    curve = next(iter(figure.panels[panel].values()))
    return stored()[curve.env] if figure.floor else None
