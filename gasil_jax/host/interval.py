"""Intervals of environment steps, counted in whole iterations."""

import math
from typing import NamedTuple

from gasil_jax.config import Config


class Interval(NamedTuple):
    """Something that is due every so many iterations.

    Attributes:
      iterations: number of iterations from one time to the next, at least 1.
    """

    iterations: int

    @classmethod
    def of_steps(cls, steps: int, config: Config) -> "Interval":
        """Return an interval of environment steps, rounded up to whole iterations."""
        return cls(math.ceil(steps / config.batch_steps))

    def is_due(self, done: int) -> bool:
        """Return whether it is due after `done` iterations."""
        return done % self.iterations == 0

    def iterations_left(self, done: int) -> int:
        """Return the iterations from `done` to the next time, at least 1."""
        return self.iterations - done % self.iterations
