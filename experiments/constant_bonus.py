"""A bonus that knows nothing: ``python -m experiments.constant_bonus``.

The discriminator's reward is never negative, so where an episode ends with a fall it
also pays for staying up, whatever the discriminator has learned. Here PPO+GASIL has
what was found best for it on delayed tasks with normalized rewards, but a discriminator
that an entropy bonus holds at 1/2 everywhere, which is alpha log 2 for each step. What
PPO+GASIL has more, imitation adds at the same alpha. (A discriminator that is only left
as it is at the start is a reward too, a random one, and the policy learns to collect
it.)
"""

import dataclasses
import sys
from collections.abc import Mapping, Sequence

from experiments import command, normalized_rewards, random_search, report
from experiments.report import Figure
from experiments.trials import PAIR, Results, Trial

#: Where falls end episodes and PPO+GASIL is ahead.
TASKS = ("hopper", "walker2d")
CONSTANT = "constant bonus"
# Against this weight what tells good from other moves a logit by 4 / 1000.
_HELD = {
    "discriminator_entropy_coefficient": 1e3,
    "discriminator_updates": 5,
    "discriminator_learning_rate": 3e-4,
}


def _conclude(shown: Mapping[str, Mapping[str, Results]]) -> str:
    """What the bonus and imitation add on each task, Markdown."""
    lines = []
    for panel, curves in shown.items():
        if not {*PAIR, CONSTANT} <= set(curves):
            continue
        ppo, bonus, gasil = (
            curves[name].final[0] for name in (PAIR[0], CONSTANT, PAIR[1])
        )
        of_bonus = report.difference(bonus, ppo)
        of_imitation = report.difference(gasil, bonus)
        more = report.contrast(((1, gasil), (-2, bonus), (1, ppo)))
        lines.append(
            f"- {panel}: the bonus adds {report.said(*of_bonus)} to PPO, "
            f"{report.verdict(*of_bonus[1:])}; imitation "
            f"{report.said(*of_imitation)} to that, "
            f"{report.verdict(*of_imitation[1:])}; more than the bonus does: "
            f"{report.verdict(*more[1:])} ({report.said(*more)})."
        )
    return "\n".join(lines)


FIGURE = Figure(
    name="constant_bonus",
    title="Delayed rewards and a bonus that knows nothing",
    claim="The discriminator's reward, learned from good trajectories, acts as a "
    "useful reward shaping that makes learning easier.",
    conclude=_conclude,
    more="""The control, "constant bonus", is PPO+GASIL with a discriminator that an
entropy bonus holds at 1/2 everywhere: alpha log 2 for each step, with no imitation.

**What it says.** Imitation is clearly a part of PPO+GASIL's margin on both tasks. The
bonus alone doubles PPO's return on walker2d; on hopper it is not clear that it adds
anything: eleven of the control's twenty seeds end with a return of about 1000, which
standing still for a whole episode has, and six run. Which of the two adds more is not
clear on either. All of the control and half of the others ran on C MuJoCo (below). The
bonus has PPO+GASIL's alpha and learning rate and was not tuned for itself; it pays more
than a trained discriminator, which is above 1/2 on what the policy does.""",
)


def make() -> list[Trial]:
    """PPO, PPO+GASIL and the control: as many seeds of each."""
    tuned = {trial.name: trial for trial in normalized_rewards.make()}
    wanted = []
    for env in TASKS:
        panel = random_search.panel(env, random_search.DELAY)
        ppo, gasil = (tuned.get(f"{panel}/{agent}") for agent in PAIR)
        # None before their searches are whole.
        if ppo is not None and gasil is not None:
            points = tuple({**point, **_HELD} for point in gasil.points)
            control = dataclasses.replace(
                gasil, name=f"{panel}/{CONSTANT}", points=points
            )
            wanted += [ppo, control, gasil]
    return wanted


def quick(wanted: Sequence[Trial]) -> list[Trial]:
    """Hopper's."""
    return [trial for trial in wanted if trial.env == "hopper"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    return command.main(FIGURE, make, quick, arguments)


if __name__ == "__main__":
    sys.exit(main())
