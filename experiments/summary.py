"""The page of all claims, and the generated blocks of the README.

A claim's verdict is computed from the comparisons on its figure's page.
"""

import dataclasses
import functools
import itertools
import json
import pathlib
import shlex
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from experiments import report
from experiments.agents import OWN
from experiments.comparisons import improvement_share
from experiments.curves import name_of
from experiments.figure_results import Results
from experiments.figures import FIGURES
from experiments.options import Options, Parser
from experiments.search import (
    ADAPTIVE,
    DELAY,
    PAIR,
    PAPERS,
    TASKS,
    PaperSearch,
    SparseSearch,
)
from experiments.store import RESULTS, Store
from experiments.tables import changed, markdown_table
from gasil_jax import presets
from gasil_jax.errors import InputError
from gasil_jax.host import output_file
from gasil_jax.statistics import interquartile_mean

#: The pages that tell of several figures.
SUMMARIES = ("README", "when_self_imitation_helps", "comparisons")
README = pathlib.Path(__file__).parent.parent / "README.md"
#: The key of a comparison of a page, and the verdict that a claim expects.
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
    delay: int,
    others: Sequence[str],
    ours: str = "ppo+gasil",
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
    _tuned(
        "Point mass, in a layout that was chosen for it: PPO+GASIL is slower at first "
        "and ends higher than PPO",
        "point_mass",
        {
            "early": [(("point_mass", "ppo+gasil early", "ppo early"), "worse")],
            "at the end": [(("point_mass", "ppo+gasil", "ppo"), "better")],
        },
        needed=2,
    ),
    _on_tasks(
        "Delayed rewards: PPO+GASIL is ahead of PPO, PPO+BC and PPO+SIL on all tasks "
        "(in the paper by a large margin, which is not judged here)",
        DELAY,
        share=1.0,
    ),
    _on_tasks(
        "Dense rewards: PPO+GASIL is ahead of these three on most tasks", 1, share=2 / 3
    ),
    _tuned(
        "Noise on observations: PPO+GASIL's lead over PPO is larger with it",
        "stochastic_walker2d",
        {key[0]: [(key, "better")] for key in _GROWS},
        needed=3,
    ),
    _tuned(
        "Discriminator updates: PPO+GASIL does poorly with too few (1) or too many "
        "(20)",
        "hyperparameters",
        _comparisons("hyperparameters", "discriminator_updates"),
        needed=4,
    ),
    _tuned(
        "Buffer: PPO+GASIL does poorly if it is too small (500 steps) or large (5000)",
        "hyperparameters",
        _comparisons("hyperparameters", "buffer_steps"),
        needed=4,
    ),
    Claim(
        "Control, not a claim of the paper: with delayed rewards PPO+GASIL is ahead of "
        "the same survival bonus without imitation (PPO+BONUS)",
        {
            protocol: Test(name, _ahead(DELAY, _CONTROL), needed=6)
            for protocol, name in (
                (PROTOCOLS[0], "paper_controls"),
                (PROTOCOLS[2], "matrix"),
            )
        },
    ),
)


#: The results of all figures, by name.
Pages = Mapping[str, Results]


def all_results(store: Store) -> Pages:
    """Return the results of all figures."""
    return {name: Results(figure, store) for name, figure in FIGURES.items()}


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
        return "not measured yet"
    agree = [case for case, agrees in measured.items() if agrees]
    judged = [x for case in measured for x in test.cases[case]]
    opposite = sum(compared[key].verdict == _OPPOSITE[x] for key, x in judged)
    lacking = len(test.cases) - len(measured)
    if len(agree) >= test.needed:
        word = "holds"
    elif len(agree) + lacking >= test.needed:
        word = "open so far"
    else:
        word = "holds in part" if 2 * len(agree) >= test.needed else "not supported"
        word = word if agree else "does not hold"
    words = f"{word}: in {len(agree)} of {len(measured)} cases"
    words += f" ({'; '.join(agree)})" if agree else ""
    shares = [
        improvement_share(pages[test.figure].scores, *key)
        for key, expected in judged
        if len(key) == 3 and expected == "better"
    ]
    if shares and len(shares) == len(judged) and not np.isnan(shares).any():
        words += f"; probability of improvement {np.mean(shares):.2f}"
    if opposite:
        words += f"; the opposite in {opposite} of {len(judged)} comparisons"
    return words + (f"; {lacking} not measured yet" if lacking else "")


def claims(pages: Pages) -> str:
    """Return a table with each claim and what was measured by each protocol."""
    rows = [
        (claim.words, *(verdict(pages, claim.tests.get(x)) for x in PROTOCOLS))
        for claim in CLAIMS
    ]
    return markdown_table(["The paper's claim", *PROTOCOLS], rows)


def effects(pages: Pages, rewards: str) -> str:
    """Return how far PPO+GASIL is ahead on each "dense" or "delayed" task."""
    claim = next(x for x in CLAIMS if x.words.lower().startswith(rewards))
    rows: dict[tuple[str, str], dict[str, str]] = {}
    for protocol, test in claim.tests.items():
        compared = pages[test.figure].comparisons
        for key, _ in itertools.chain(*test.cases.values()):
            words = "not measured yet"
            if key in compared:
                words = f"{compared[key]}, {compared[key].verdict_in_words()}"
            other = key[2].partition(" (")[0]
            rows.setdefault((key[0], other), {})[protocol] = words
    return markdown_table(
        ["task", "ahead of", *PROTOCOLS],
        [[*names, *(x.get(y, "") for y in PROTOCOLS)] for names, x in rows.items()],
    )


def figures(pages: Pages) -> str:
    """Return links to the pages of all figures."""
    return "\n".join(f"- [{FIGURES[name].title}]({name}.md)" for name in pages)


def front(pages: Pages) -> str:
    """Return the README's text on the results."""
    return text(pages, "front").rstrip()


_SLOTS = {x.__name__: x for x in (claims, effects, figures, front)}


def value(pages: Pages, name: str, *arguments: str) -> str:
    """Return the text of a slot: one of the above, or a figure's name and its slot.

    Raises:
      InputError: if there is no such slot.
    """
    if name in _SLOTS:
        return _SLOTS[name](pages, *arguments)
    if name in pages and arguments:
        return report.value(pages[name], *arguments)
    raise InputError(
        f"slot is {shlex.join([name, *arguments])}: it must be one of "
        f"{', '.join(_SLOTS)}, or a figure and its slot"
    )


def text(pages: Pages, note: str) -> str:
    """Return a note, such as a page of `SUMMARIES`, with its slots filled in."""
    return report.fill(report.note(note), functools.partial(value, pages))


def tuned(pages: Pages) -> str:
    """Return the tuned presets as JSON, updated by what complete searches chose."""
    rows = json.loads(presets.TUNED.read_text())
    final = {
        one.curve.search: float(interquartile_mean(one.final))
        for name in ("matrix", "ppo_values")
        for one in pages[name].curves.values()
        if one.complete
    }
    for results in pages.values():
        for search in results.figure.searches.values():
            # The preset "paper" has normalized rewards and the paper's bonus, "scaled"
            # decomposed rewards.
            other = search.decompose_rewards or getattr(search, "bonus", None)
            other = other or not getattr(search, "normalize_rewards", True)
            # On the sparse tasks each agent has one setting for all, and so has
            # adaptive imitation where that returns about as much as its searches. The
            # experiments' own agents have no presets.
            kind = "delayed" if search.reward_delay > 1 else "dense"
            is_own = kind == "delayed" and search.env in ("ant", "humanoid")
            single = search.agent == ADAPTIVE and not is_own
            single |= isinstance(search, SparseSearch) or search.agent in OWN
            # The best of its own values and of those that PPO's and PPO+GASIL's
            # searches chose, by the final returns on the pages.
            others = [dataclasses.replace(search, chooser=x) for x in PAIR]
            best = max([search, *others], key=lambda x: final.get(x, -np.inf))
            point = best.chosen(results.searched)
            if point is None or single or other:
                continue
            kind = f"paper {kind}" if isinstance(search, PaperSearch) else kind
            of_task = rows.setdefault(kind, {}).setdefault(search.env, {})
            settings = changed(search.algorithm(point))
            of_task[search.agent] = dict(sorted(settings.items()))
    return json.dumps(rows, indent=1, sort_keys=True) + "\n"


def parser() -> Parser:
    """Return the reader of the command's options, of which there are none."""
    about = "Write all pages, plots and presets, and the README's text on results."
    return Parser("report", about)


def run(options: Options) -> None:
    """Write all that is made from stored runs."""
    pages = all_results(Store(RESULTS / "runs"))
    for name, results in pages.items():
        report.write(name, results, RESULTS)
    blocks = report.fill_blocks(README.read_text(), functools.partial(value, pages))
    for path, content in (
        *((RESULTS / f"{page}.md", text(pages, page)) for page in SUMMARIES),
        (README, blocks),
        (presets.TUNED, tuned(pages)),
    ):
        with output_file.atomic(path) as partial:
            partial.write_text(content)
    print(f"in {RESULTS}")
