"""Noise on Walker2d (paper, figure 6): ``python -m experiments.stochastic_walker2d``.

Both agents have what the search found best for them without noise, and under noise what
it found best there, once it is whole.
"""

import sys
from collections.abc import Sequence

from experiments import command, random_search, report
from experiments.report import Figure
from experiments.trials import PAIR, Trial

NOISES = (0.0, 0.05, 0.1, 0.5)

FIGURE = Figure(
    name="stochastic_walker2d",
    title="Walker2d with noisy observations (paper, figure 6)",
    claim="The gap between PPO and PPO+GASIL is larger when Gaussian noise, of "
    "standard deviation 0.05, 0.1 and 0.5, is added to the observations.",
    more="""**What it says.** Both agents have the hyperparameters that the search
chose without noise, where the discriminator's reward has no weight
([figure 5](mujoco.md)), so that no gap can grow. The noise is large: at 0.1 and above
both learn little. Not tried: tuning both agents under noise.""",
    conclude=lambda shown: report.gaps(shown, "noise 0", "ppo+gasil", "ppo"),
)


def make() -> list[Trial]:
    """Both agents at every noise."""
    tuned = all(
        random_search.is_whole("walker2d", agent, obs_noise=random_search.NOISE)
        for agent in PAIR
    )
    tuned_at = {
        noise: random_search.NOISE if noise and tuned else 0.0 for noise in NOISES
    }
    return [
        Trial(
            name=f"noise {noise:g}/{agent}",
            env="walker2d",
            agent=agent,
            obs_noise=noise,
            points=(
                random_search.best("walker2d", agent, obs_noise=tuned_at[noise]) or {},
            ),
        )
        for noise in NOISES
        for agent in PAIR
    ]


def quick(wanted: list[Trial]) -> list[Trial]:
    """Without noise, and with some."""
    return [trial for trial in wanted if trial.obs_noise in (0.0, 0.1)]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    return command.main(FIGURE, make, quick, arguments)


if __name__ == "__main__":
    sys.exit(main())
