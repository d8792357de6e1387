"""The page of all claims, and the blocks of the README that are generated.

A block stands between ``<!-- begin SLOT -->`` and ``<!-- end -->``. A claim's verdict
is a rule on the comparisons of its figure's page.
"""

import pathlib
import re
import shlex
from collections.abc import Callable, Mapping, Sequence

from experiments import report
from experiments.figures import FIGURES, NORMALIZED, name_of
from experiments.report import Page
from experiments.search import AGENTS, DELAY, TASKS
from experiments.store import RESULTS, Store
from gasil_jax.errors import InputError
from gasil_jax.host import output_file

README = pathlib.Path(__file__).parent.parent / "README.md"
_COMPARISONS = {DELAY: "delayed_mujoco", 1: "mujoco"}


class Summary:
    """The page of all claims and the README's blocks, from one store."""

    def __init__(self, store: Store):
        self.pages = {name: Page(name, store) for name in FIGURES}

    def _ahead(self, figure: str, panels: Sequence[str], all_of_them: bool) -> str:
        """Holds if PPO+GASIL is better than every other agent on most or all tasks."""
        compared = self.pages[figure].comparisons
        verdicts = {
            panel: [x.verdict for key, x in compared.items() if key[0] == panel]
            for panel in panels
        }
        better = [p for p, x in verdicts.items() if x and set(x) == {"better"}]
        worse = [p for p, x in verdicts.items() if "worse" in x]
        needed = len(panels) if all_of_them else len(panels) // 2 + 1
        word = "holds" if len(better) >= needed else "holds in part"
        words = f"{word if better else 'does not hold'}: better than all three on "
        words += f"{len(better)} of {len(panels)} tasks"
        words += f" ({', '.join(better)})" if better else ""
        return words + (f", worse than one on {', '.join(worse)}" if worse else "")

    def _point_mass(self) -> str:
        """Holds if PPO+GASIL is worse early and better at the end."""
        page = self.pages["point_mass"]
        early = page.verdict("point_mass", "ppo+gasil early", "ppo early")
        late = page.verdict("point_mass", "ppo+gasil", "ppo")
        word = "holds" if (early, late) == ("worse", "better") else "does not hold"
        layout = "in a layout that was chosen for it"
        return f"{word}: {early} early, {late} at the end, {layout}"

    def _noise(self) -> str:
        """Holds if the gap at some noise is clearly larger than without."""
        compared = self.pages["stochastic_walker2d"].comparisons
        better = [key for key, x in compared.items() if x.verdict == "better"]
        ahead = ", ".join(key[0] for key in better if len(key) == 3) or "none"
        grows = ", ".join(key[0] for key in better if len(key) == 4)
        return (
            f"{'holds' if grows else 'not clear'}: better than PPO at {ahead}; by "
            f"clearly more than without noise at {grows or 'none'}"
        )

    def _ends(self, name: str, few: str, many: str) -> str:
        """Holds if the best value is better than both of these in most panels."""
        page = self.pages["hyperparameters"]
        panels = [panel for panel in page.figure.panels if panel.startswith(name)]
        counts = {
            end: sum(
                page.verdict(panel, page.best_value(panel), end) == "better"
                for panel in panels
                if page.best_value(panel) != end
            )
            for end in (few, many)
        }
        word = "holds in part" if any(counts.values()) else "not clear"
        word = "holds" if min(counts.values()) > len(panels) / 2 else word
        words = " and ".join(f"than {end} in {count}" for end, count in counts.items())
        return f"{word}: the best value is better {words} of {len(panels)} panels"

    def claims(self) -> str:
        """Return a table with each claim of the paper and our measurements."""
        dense, delayed = (
            [name_of(x, delay) for x in NORMALIZED] for delay in (1, DELAY)
        )
        normalized = "The same, with normalized rewards"
        rows = [
            (
                "Point mass: PPO settles early on a poorer policy, PPO+GASIL is slower "
                "at first and ends higher",
                self._point_mass(),
            ),
            (
                "Dense rewards: PPO+GASIL is ahead of PPO, PPO+BC and PPO+SIL on most "
                "tasks",
                self._ahead("mujoco", TASKS, False),
            ),
            (normalized, self._ahead("normalized_rewards", dense, False)),
            (
                "Delayed rewards: it is ahead of them by a large margin on all tasks",
                self._ahead("delayed_mujoco", TASKS, True),
            ),
            (normalized, self._ahead("normalized_rewards", delayed, True)),
            ("Noise: the gap to PPO is larger with it", self._noise()),
            (
                "Discriminator updates: too few (1) and too many (20) do poorly",
                self._ends("discriminator_updates", "1", "20"),
            ),
            (
                "Buffer: too small (500 steps) and too large (5000) do poorly",
                self._ends("buffer_steps", "500", "5000"),
            ),
        ]
        return report.markdown_table(["The paper's claim", "Here"], rows)

    def _table(self, rows: Mapping[str, tuple[str, str]]) -> str:
        """Agents on tasks: name of a row -> figure and panel."""
        table = []
        for name, (figure, panel) in rows.items():
            of = self.pages[figure].results.get(panel, {})
            final = lambda x: (
                report.interval(x.final) + ("" if x.complete else f" ({x.seeds} seeds)")
            )
            cells = [final(of[agent]) if agent in of else "" for agent in AGENTS]
            table.append([name, *cells])
        return report.markdown_table(["", *map(str.upper, AGENTS)], table)

    def as_they_are(self) -> str:
        """Rewards as they are, where there are normalized ones too."""
        each = [(env, delay) for delay in _COMPARISONS for env in NORMALIZED]
        return self._table({_row(*x): (_COMPARISONS[x[1]], x[0]) for x in each})

    def tuned(self) -> str:
        """Every agent with its tuned preset."""
        each = [(env, delay) for delay in _COMPARISONS for env in NORMALIZED]
        rows = {_row(*x): ("normalized_rewards", name_of(*x)) for x in each}
        others = [(env, delay) for delay in _COMPARISONS for env in TASKS[4:]]
        rows |= {_row(*x): (_COMPARISONS[x[1]], x[0]) for x in others}
        return self._table(rows)

    def figures(self) -> str:
        """Links to the pages of all figures."""
        return "\n".join(f"- [{x.figure.title}]({n}.md)" for n, x in self.pages.items())

    def value(self, name: str, *arguments: str) -> str:
        """What stands in a slot: one of these, or a figure's name and its slot.

        Raises:
          InputError: there is no such slot.
        """
        own: dict[str, Callable[[], str]] = {
            "claims": self.claims,
            "tuned": self.tuned,
            "as_they_are": self.as_they_are,
            "figures": self.figures,
        }
        if name in own and not arguments:
            return own[name]()
        if name in self.pages and arguments:
            return self.pages[name].value(*arguments)
        raise InputError(
            f"slot is {shlex.join([name, *arguments])}: it must be one of "
            f"{', '.join(own)}, or a figure and its slot"
        )

    def text(self) -> str:
        """Return the page of all claims as Markdown."""
        note = report.fill((report.NOTES / "README.md").read_text(), self.value)
        title, body = note.split("\n", 1)
        in_step = any(page.in_step for page in self.pages.values())
        parts = [title, *([report.IN_STEP] if in_step else []), body.strip()]
        return "\n\n".join(parts) + "\n"

    def fill_blocks(self, text: str) -> str:
        """Return a document with its generated blocks replaced by new ones."""
        block = re.compile(r"(<!-- begin (.+?) -->\n).*?(<!-- end -->)", re.DOTALL)
        made = lambda match: self.value(*shlex.split(match[2]))
        return block.sub(lambda x: f"{x[1]}\n{made(x)}\n\n{x[3]}", text)

    def write(self) -> None:
        """Write the page of all claims and the README's blocks."""
        texts = {RESULTS / "README.md": self.text()}
        texts[README] = self.fill_blocks(README.read_text())
        for path, text in texts.items():
            with output_file.whole(path) as partial:
                partial.write_text(text)


def _row(env: str, delay: int) -> str:
    return env if delay == 1 else f"{env}, delayed"
