"""The page of all claims, and the blocks of the README that are generated.

A claim's verdict is a rule on the comparisons of its figure's page.
"""

import pathlib
import shlex
from collections.abc import Mapping, Sequence

from experiments import report
from experiments.figures import FIGURES, NORMALIZED, name_of
from experiments.report import Page
from experiments.search import AGENTS, DELAY, TASKS
from experiments.store import RESULTS, Store
from gasil_jax.errors import InputError
from gasil_jax.host import output_file

README = pathlib.Path(__file__).parent.parent / "README.md"
#: A figure and one of its panels, by the name of a row in a table.
_Rows = Mapping[str, tuple[str, str]]


def _rows(tasks: Sequence[str]) -> _Rows:
    """Return the tasks with rewards as they are, delayed ones first."""
    delayed = {f"{env}, delayed": ("delayed_mujoco", env) for env in tasks}
    return delayed | {env: ("mujoco", env) for env in tasks}


class Summary:
    """The page of all claims and the README's blocks, from one store."""

    #: The methods that slots may name; others name a figure and one of its slots.
    SLOTS = ("claims", "tuned", "as_they_are", "figures")

    def __init__(self, store: Store):
        self.pages = {name: Page(name, store) for name in FIGURES}

    def _ahead(self, figure: str, panels: Sequence[str], needed: int) -> str:
        """Holds if PPO+GASIL is better than each other agent on so many tasks."""
        compared = self.pages[figure].comparisons.items()
        verdicts = {
            p: {x.verdict for key, x in compared if key[0] == p} for p in panels
        }
        better = [panel for panel in panels if verdicts[panel] == {"better"}]
        worse = [panel for panel in panels if "worse" in verdicts[panel]]
        word = "holds" if len(better) >= needed else "holds in part"
        words = f"{word if better else 'does not hold'}: better than all three on "
        words += f"{len(better)} of {len(panels)} tasks"
        words += f" ({', '.join(better)})" if better else ""
        return words + (f", worse than one on {', '.join(worse)}" if worse else "")

    def _point_mass(self) -> str:
        """Holds if PPO+GASIL is worse early and better at the end."""
        early, late = (
            self.pages["point_mass"].verdict("point_mass", f"ppo+gasil{x}", f"ppo{x}")
            for x in (" early", "")
        )
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
        best = {panel: page.best_value(panel) for panel in panels}
        counts = [
            sum(
                x != end and page.verdict(p, x, end) == "better"
                for p, x in best.items()
            )
            for end in (few, many)
        ]
        word = "holds in part" if any(counts) else "not clear"
        word = "holds" if min(counts) > len(panels) / 2 else word
        words = f"than {few} in {counts[0]} and than {many} in {counts[1]}"
        return f"{word}: the best value is better {words} of {len(panels)} panels"

    def claims(self) -> str:
        """Return a table with each claim of the paper and our measurements."""
        dense, delayed = ([name_of(x, d) for x in NORMALIZED] for d in (1, DELAY))
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
                self._ahead("mujoco", TASKS, needed=4),
            ),
            (normalized, self._ahead("normalized_rewards", dense, needed=3)),
            (
                "Delayed rewards: it is ahead of them by a large margin on all tasks",
                self._ahead("delayed_mujoco", TASKS, needed=6),
            ),
            (normalized, self._ahead("normalized_rewards", delayed, needed=4)),
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

    def _table(self, rows: _Rows) -> str:
        """Return the final returns of all agents."""
        table = []
        for name, (figure, panel) in rows.items():
            cells = []
            for x in (self.pages[figure].results.get((panel, y)) for y in AGENTS):
                seeds = "" if x is None or x.complete else f" ({x.seeds} seeds)"
                cells.append(f"{report.interval(x.final)}{seeds}" if x else "")
            table.append([name, *cells])
        return report.markdown_table(["", *map(str.upper, AGENTS)], table)

    def as_they_are(self) -> str:
        """Return the results with rewards as they are of tasks with others too."""
        return self._table(_rows(NORMALIZED))

    def tuned(self) -> str:
        """Return the results of every agent with its tuned preset."""
        rows = {
            name: ("normalized_rewards", name.replace(", ", "-"))
            for name in _rows(NORMALIZED)
        }
        return self._table({**rows, **_rows(TASKS[len(NORMALIZED) :])})

    def figures(self) -> str:
        """Return links to the pages of all figures."""
        begun = {name: page for name, page in self.pages.items() if page.begun}
        return "\n".join(f"- [{x.figure.title}]({n}.md)" for n, x in begun.items())

    def value(self, name: str, *arguments: str) -> str:
        """Return what stands in a slot: one of these, or a figure's name and its slot.

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
        note = report.fill((report.NOTES / "README.md").read_text(), self.value)
        title, body = note.split("\n", 1)
        in_step = any(page.in_step for page in self.pages.values())
        parts = [title, *([report.IN_STEP] if in_step else []), body.strip()]
        return "\n\n".join(parts) + "\n"

    def write(self) -> None:
        """Write the page of all claims and the README's blocks."""
        text = report.fill_blocks(README.read_text(), self.value)
        for path, content in ((RESULTS / "README.md", self.text()), (README, text)):
            with output_file.whole(path) as partial:
                partial.write_text(content)
