"""The options that name a policy, for the commands that run one."""

import dataclasses
import pathlib
from typing import Literal

from gasil_jax.cli.parsing import POSITIONAL, input_checked
from gasil_jax.errors import InputError
from gasil_jax.host.saved import Policies, best_of, load_policies
from gasil_jax.numpy_policy import ZOO_PREFIX


@dataclasses.dataclass(frozen=True)
class PolicyOptions:
    """The policies of a run, or of a point of a sweep.

    Attributes:
      run: folder of the run or sweep, which need not be finished, or zoo:NAME, one of
        the package's policies.
      point: number of a sweep's point in results.csv; default the one with the
        highest mean final return, of those whose seeds all stayed finite.
      checkpoint: checkpoint of the policies: last, or best, which has the best
        evaluation or, without evaluations, the best mean return in training.
      stochastic: draw actions from the policy instead of taking its mean.
      key: random key of the episodes' starts and actions.
    """

    run: pathlib.Path = dataclasses.field(metadata=POSITIONAL)
    point: int | None = None
    checkpoint: Literal["last", "best"] = "last"
    stochastic: bool = False
    key: int = 0

    def load(self, seed: int | None, *, only_best: bool = False) -> Policies:
        """Return the policies of a seed; by default of all or of the best one."""
        # Both JAX and Gymnasium accept these numbers.
        if not 0 <= self.key < 2**32:
            raise InputError(f"key is {self.key}: it must be from 0 to {2**32 - 1}")
        with input_checked():
            point = self.point
            # A policy of the zoo has one seed, which needs no name.
            of_zoo = str(self.run).startswith(ZOO_PREFIX)
            if only_best and seed is None and not of_zoo:
                point, seed = best_of(self.run, point)
            return load_policies(self.run, self.checkpoint, point, seed=seed)
