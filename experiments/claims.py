"""The paper's claims, and whether they hold, by the comparisons of figures."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from experiments.curves import name_of
from experiments.figure_results import Results
from experiments.figures import FIGURES
from experiments.search import DELAY, PAPERS, TASKS
from experiments.tables import markdown_table

#: The results of figures, by name.
Pages = Mapping[str, Results]
#: The key of a comparison of a figure, and the verdict that a claim expects.
_Expected = tuple[tuple[str, ...], str]
_OPPOSITE = {"better": "worse", "worse": "better"}


class Test(NamedTuple):
    """The verdicts of one figure with which a claim holds.

    Attributes:
      figure: name of the figure whose comparisons decide.
      cases: the expected verdicts by case, such as a task. A case agrees if all of its
        comparisons have the expected verdict.
      needed: the number of cases that must agree for the claim to hold. If fewer agree,
        it holds in part, or is not supported if fewer than half of these agree.
    """

    figure: str
    cases: Mapping[str, Sequence[_Expected]]
    needed: int


#: The protocols that claims are tested under, in the order of the table's columns.
PROTOCOLS = ("the paper's protocol", "equal settings", "all tuned")


class Claim(NamedTuple):
    """A claim as text, and its tests by protocol."""

    words: str
    tests: Mapping[str, Test]


def _tuned(words: str, *test: Any, **more: Any) -> Claim:
    """Return a claim that was tested only where all agents are tuned."""
    return Claim(words, {PROTOCOLS[-1]: Test(*test, **more)})


def _ahead(
    delay: int, others: Sequence[str], ours: str = "ppo+gasil"
) -> dict[str, list[_Expected]]:
    """Expect PPO+GASIL to be better than other agents on each task."""
    panels = [name_of(env, delay) for env in TASKS]
    return {p: [((p, ours, x), "better") for x in others] for p in panels}


def _on_tasks(words: str, delay: int, share: float) -> Claim:
    """Return the claim to be ahead of the paper's other agents on a share of tasks."""
    equal = tuple(x if x == "ppo" else f"{x} (PPO's values)" for x in _OTHERS)
    of = {
        "paper_protocol": _ahead(delay, _OTHERS),
        "ppo_values": _ahead(delay, equal, ours="ppo+gasil (PPO's values)"),
        "matrix": _ahead(delay, _OTHERS),
    }
    tests = [Test(name, cases, round(share * len(cases))) for name, cases in of.items()]
    return Claim(words, dict(zip(PROTOCOLS, tests, strict=True)))


def _comparisons(name: str, prefix: str = "") -> dict[str, list[_Expected]]:
    """Expect the first curve to be better, on panels that begin with a prefix."""
    keys = [key for key in FIGURES[name].compared() if key[0].startswith(prefix)]
    return {f"{key[0]}, {key[1]} against {key[2]}": [(key, "better")] for key in keys}


_OTHERS, _CONTROL = PAPERS[:-1], ("ppo+bonus",)
_GROWS = [key for key in FIGURES["stochastic_walker2d"].compared() if len(key) == 4]
CLAIMS = (
    _on_tasks(
        "Delayed rewards: PPO+GASIL returns more than PPO, PPO+BC and PPO+SIL on all "
        "tasks",
        DELAY,
        share=1.0,
    ),
    Claim(
        "Our control: with delayed rewards it also returns more than PPO with the same "
        "bonus in every step, without imitation",
        {
            protocol: Test(name, _ahead(DELAY, _CONTROL), needed=6)
            for protocol, name in (
                (PROTOCOLS[0], "paper_controls"),
                (PROTOCOLS[2], "matrix"),
            )
        },
    ),
    _on_tasks(
        "Dense rewards: PPO+GASIL returns more than these three on most tasks",
        1,
        share=2 / 3,
    ),
    _tuned(
        "Point mass: PPO+GASIL is slower at first and ends higher than PPO (the layout "
        "was chosen for it)",
        "point_mass",
        {
            "early": [(("point_mass", "ppo+gasil early", "ppo early"), "worse")],
            "at the end": [(("point_mass", "ppo+gasil", "ppo"), "better")],
        },
        needed=2,
    ),
    _tuned(
        "Noise on observations makes PPO+GASIL's lead over PPO larger",
        "stochastic_walker2d",
        {key[0]: [(key, "better")] for key in _GROWS},
        needed=3,
    ),
    _tuned(
        "PPO+GASIL does poorly with too few (1) or too many (20) discriminator updates",
        "hyperparameters",
        _comparisons("hyperparameters", "discriminator_updates"),
        needed=4,
    ),
    _tuned(
        "PPO+GASIL does poorly with a small (500 steps) or large (5000) buffer",
        "hyperparameters",
        _comparisons("hyperparameters", "buffer_steps"),
        needed=4,
    ),
)


def verdict(pages: Pages, test: Test | None) -> str:
    """Return as text whether a claim holds, judged by the complete curves."""
    if test is None:
        return ""
    compared = pages[test.figure].comparisons
    measured = {
        case: all(compared[key].verdict == verdict for key, verdict in expected)
        for case, expected in test.cases.items()
        if all(key in compared for key, _ in expected)
    }
    if not measured:
        return "not measured"
    agree = [case for case, agrees in measured.items() if agrees]
    judged = [x for case in measured for x in test.cases[case]]
    opposite = sum(compared[key].verdict == _OPPOSITE[x] for key, x in judged)
    lacking = len(test.cases) - len(measured)
    if len(agree) >= test.needed:
        word = "holds"
    elif len(agree) + lacking >= test.needed:
        word = "open"
    else:
        word = "holds in part" if 2 * len(agree) >= test.needed else "not supported"
        word = word if agree else "does not hold"
    words = f"**{word}**: {len(agree)} of {len(measured)}"
    words += f" ({', '.join(agree)})" if agree else ""
    if opposite:
        words += f"; the opposite in {opposite} of {len(judged)} comparisons"
    return words + (f"; {lacking} not measured" if lacking else "")


def table(pages: Pages) -> str:
    """Return a table with each claim and what was measured by each protocol."""
    rows = [
        (claim.words, *(verdict(pages, claim.tests.get(x)) for x in PROTOCOLS))
        for claim in CLAIMS
    ]
    return markdown_table(["The paper's claim", *PROTOCOLS], rows)
