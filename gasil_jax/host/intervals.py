"""Regular intervals of training, in whole iterations."""

import math

from gasil_jax.config import Config


class Interval:
    """Environment steps of a seed, rounded up to iterations; None is no interval."""

    def __init__(self, env_steps: int | None, config: Config):
        self.length, self._last = math.inf, config.num_iterations
        if env_steps is not None:
            self.length = math.ceil(env_steps / config.batch_steps)

    def left(self, done: int) -> float:
        """Return the iterations from `done` to the next end, at least one."""
        return self.length - done % self.length

    def ends(self, done: int) -> bool:
        """Return whether an interval ends after `done` iterations."""
        return done % self.length == 0

    def is_due(self, done: int) -> bool:
        """Return whether an interval ends, or training, after `done` iterations."""
        return self.ends(done) or done == self._last
