"""The page of all claims, and the generated blocks of the README.

A claim's verdict is computed from the comparisons on its figure's page.
"""

import json
import pathlib
import shlex
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from experiments import report
from experiments.curves import name_of
from experiments.figures import FIGURES
from experiments.report import Page
from experiments.search import ADAPTIVE, DELAY, TASKS
from experiments.store import RESULTS, Store
from gasil_jax import presets
from gasil_jax.errors import InputError
from gasil_jax.host import output_file

README = pathlib.Path(__file__).parent.parent / "README.md"
#: The key of a comparison of a page, and the verdict that a claim expects.
_Expected = tuple[tuple[str, ...], str]
_OPPOSITE = {"better": "worse", "worse": "better"}


class Claim(NamedTuple):
    """A claim, and the verdicts with which it holds.

    Attributes:
      words: the claim as text.
      figure: name of the figure whose comparisons decide.
      cases: the expected verdicts by case, such as a task. A case agrees if all of its
        comparisons have the expected verdict.
      needed: the number of cases that must agree for the claim to hold. If fewer agree,
        it holds in part.
    """

    words: str
    figure: str
    cases: Mapping[str, Sequence[_Expected]]
    needed: int


def _ahead(delay: int, others: Sequence[str]) -> dict[str, list[_Expected]]:
    """Expect PPO+GASIL to be better than other agents on each task."""
    panels = [name_of(env, delay) for env in TASKS]
    return {p: [((p, "ppo+gasil", x), "better") for x in others] for p in panels}


def _comparisons(name: str, prefix: str = "") -> dict[str, list[_Expected]]:
    """Expect the first of two curves to be better, in each comparison of a figure.

    Args:
      name: name of the figure.
      prefix: only panels whose names begin with it count.
    """
    keys = [key for key in FIGURES[name].compared() if key[0].startswith(prefix)]
    return {f"{key[0]}, {key[1]} against {key[2]}": [(key, "better")] for key in keys}


_OTHERS, _CONTROL = ("ppo", "ppo+bc", "ppo+sil"), ("ppo+bonus",)
_GROWS = [key for key in FIGURES["stochastic_walker2d"].compared() if len(key) == 4]
CLAIMS = (
    Claim(
        "Point mass, in a layout that was chosen for it: PPO+GASIL is slower at first "
        "and ends higher than PPO",
        "point_mass",
        {
            "early": [(("point_mass", "ppo+gasil early", "ppo early"), "worse")],
            "at the end": [(("point_mass", "ppo+gasil", "ppo"), "better")],
        },
        needed=2,
    ),
    Claim(
        "Dense rewards: PPO+GASIL is ahead of PPO, PPO+BC and PPO+SIL on most tasks",
        "matrix",
        _ahead(1, _OTHERS),
        needed=4,
    ),
    Claim(
        "Delayed rewards: PPO+GASIL is ahead of these three on all tasks (in the paper "
        "by a large margin, which is not judged here)",
        "matrix",
        _ahead(DELAY, _OTHERS),
        needed=6,
    ),
    Claim(
        "Noise on observations: PPO+GASIL's lead over PPO is larger with it",
        "stochastic_walker2d",
        {key[0]: [(key, "better")] for key in _GROWS},
        needed=3,
    ),
    Claim(
        "Discriminator updates: PPO+GASIL does poorly with too few (1) or too many "
        "(20)",
        "hyperparameters",
        _comparisons("hyperparameters", "discriminator_updates"),
        needed=4,
    ),
    Claim(
        "Buffer: PPO+GASIL does poorly if it is too small (500 steps) or large (5000)",
        "hyperparameters",
        _comparisons("hyperparameters", "buffer_steps"),
        needed=4,
    ),
    Claim(
        "Control, not a claim of the paper: with delayed rewards PPO+GASIL is ahead of "
        "the same survival bonus without imitation (PPO+BONUS)",
        "matrix",
        _ahead(DELAY, _CONTROL),
        needed=6,
    ),
)


class Summary:
    """The page of all claims and the README's blocks, from one store."""

    #: The methods that slots may name. Other slots are a figure's name and its slot.
    SLOTS = ("claims", "figures")

    def __init__(self, store: Store):
        self.pages = {name: Page(name, store) for name in FIGURES}

    def verdict(self, claim: Claim) -> str:
        """Return as text whether a claim holds, judged by the complete curves."""
        compared = self.pages[claim.figure].comparisons
        measured = {
            case: all(compared[key].verdict == verdict for key, verdict in expected)
            for case, expected in claim.cases.items()
            if all(key in compared for key, _ in expected)
        }
        if not measured:
            return "not measured yet"
        agree = [case for case, agrees in measured.items() if agrees]
        opposite = [
            case if len(claim.cases[case]) == 1 else f"{case} against {key[2]}"
            for case in measured
            for key, verdict in claim.cases[case]
            if compared[key].verdict == _OPPOSITE[verdict]
        ]
        lacking = len(claim.cases) - len(measured)
        if len(agree) >= claim.needed:
            word = "holds"
        elif len(agree) + lacking >= claim.needed:
            word = "open so far"
        else:
            word = "holds in part" if agree else "does not hold"
        words = f"{word}: in {len(agree)} of {len(measured)} cases"
        words += f" ({'; '.join(agree)})" if agree else ""
        if opposite:
            words += f"; the opposite ({'; '.join(opposite)})"
        return words + (f"; {lacking} not measured yet" if lacking else "")

    def claims(self) -> str:
        """Return a table with each claim and what was measured."""
        rows = [(claim.words, self.verdict(claim)) for claim in CLAIMS]
        return report.markdown_table(["The paper's claim", "Here"], rows)

    def figures(self) -> str:
        """Return links to the pages of all figures."""
        pages = self.pages.items()
        return "\n".join(f"- [{page.figure.title}]({name}.md)" for name, page in pages)

    def value(self, name: str, *arguments: str) -> str:
        """Return the text of a slot: a method in `SLOTS`, or a figure's name and slot.

        Raises:
          InputError: if there is no such slot.
        """
        if name in self.SLOTS and not arguments:
            return getattr(self, name)()
        if name in self.pages and arguments:
            return self.pages[name].value(*arguments)
        raise InputError(
            f"slot is {shlex.join([name, *arguments])}: it must be one of "
            f"{', '.join(self.SLOTS)}, or a figure and its slot"
        )

    def text(self) -> str:
        """Return the page of all claims as Markdown."""
        return report.fill((report.NOTES / "README.md").read_text(), self.value)

    def tuned(self) -> str:
        """Return the tuned presets as JSON, updated by what complete searches chose.

        For decomposed rewards there are no rows of earlier searches, so an incomplete
        search gives its best point so far.
        """
        rows = json.loads(presets.TUNED.read_text())
        for page in self.pages.values():
            for search in page.figure.searches.values():
                choose = search.leading if search.decompose_rewards else search.chosen
                point = choose(page.searched)
                # Adaptive imitation has one setting for all tasks.
                if point is None or search.agent == ADAPTIVE:
                    continue
                config = report.changed(search.config(point))
                kind = "delayed" if search.reward_delay > 1 else "dense"
                kind = "decomposed" if search.decompose_rewards else kind
                of_task = rows[kind].setdefault(search.env, {})
                of_task[search.agent] = dict(sorted(config.items()))
        return json.dumps(rows, indent=1, sort_keys=True) + "\n"

    def write(self) -> None:
        """Write the page of all claims, the README's blocks and the presets."""
        text = report.fill_blocks(README.read_text(), self.value)
        for path, content in (
            (RESULTS / "README.md", self.text()),
            (README, text),
            (presets.TUNED, self.tuned()),
        ):
            with output_file.atomic(path) as partial:
                partial.write_text(content)
