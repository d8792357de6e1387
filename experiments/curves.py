"""What a figure is made of: curves, grids of panels, and comparisons."""

import dataclasses
import itertools
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from experiments.agents import AGENTS
from experiments.search import (
    DELAY,
    PAPERS,
    SPARSE_ROBOTS,
    Point,
    Search,
)
from experiments.store import Store
from gasil_jax import presets
from gasil_jax.algorithms import Algorithm
from gasil_jax.host.environments import Settings
from gasil_jax.host.runs import Run

#: A weighted sum of the interquartile means of curves, by panel and curve.
Terms = tuple[tuple[float, str, str], ...]
#: Terms to compare with 0, by (panel, ours, other), or by (panel, ours, other, a panel
#: whose difference is subtracted).
Comparisons = Mapping[tuple[str, ...], Terms]


@dataclasses.dataclass(frozen=True)
class Curve:
    """Seeds of one agent on one task.

    Attributes:
      env: name of the task.
      agent: name of the agent.
      changes: settings of the algorithm to change, by name.
      reward_delay: the task's reward delay, in steps.
      settings: other settings of the task, by name.
      base: the settings before the changes: a preset's, by its name; the defaults, by
        None; or what a search chose, by a function of task, agent and
        delay that returns the search.
      seeds: number of seeds.
      first_seed: number of the first seed.
      total_steps: environment steps per seed.
    """

    env: str
    agent: str
    changes: Point = dataclasses.field(default_factory=dict)
    reward_delay: int = 1
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    base: str | Callable[[str, str, int], Search] | None = "tuned"
    seeds: int = 10
    first_seed: int = 0
    total_steps: int = 1_000_000

    @property
    def search(self) -> Search | None:
        """The search that chooses the settings, or None."""
        if callable(self.base):
            return self.base(self.env, self.agent, self.reward_delay)
        return None

    @property
    def family(self) -> tuple[bool, bool, bool]:
        """Whether rewards are delayed and raw, and whether the agent is the paper's."""
        search = self.search
        raw = not getattr(search, "normalize_rewards", True)
        sees_phase = self.settings.get("observe_phase", False)
        other = self.changes or sees_phase or (search and search.decompose_rewards)
        own = search is not None and not other
        return self.reward_delay > 1, raw, own and self.agent in PAPERS

    def point(self, searched: Store) -> Point | None:
        """Return the changed settings, or None if the curve's search lacks runs."""
        chosen = self.search.chosen(searched) if self.search else {}
        return None if chosen is None else {**chosen, **self.changes}

    def runs(self, searched: Store) -> tuple[Run, ...]:
        """Return the curve's runs, or none if its search is not complete."""
        if (point := self.point(searched)) is None:
            return ()
        algorithm = Algorithm(AGENTS[self.agent]())
        if self.search:
            algorithm = self.search.algorithm({})
        elif isinstance(self.base, str):
            algorithm = presets.preset(
                self.env,
                AGENTS[self.agent],
                self.base,
                reward_delay=self.reward_delay,
            )
        algorithm = algorithm.replace(**{"total_steps": self.total_steps, **point})
        settings = Settings(reward_delay=self.reward_delay, **self.settings)
        seeds = range(self.first_seed, self.first_seed + self.seeds)
        return tuple(Run(self.env, algorithm, seed, settings) for seed in seeds)


Panels = Mapping[str, Mapping[str, Curve]]


@dataclasses.dataclass(frozen=True)
class Figure:
    """A figure: curves, and what is compared.

    Attributes:
      title: what it is about.
      claim: the paper's claim; empty if it has none about this.
      panels: the curves by panel and name.
      favourite: name of the curve that is compared with each other curve of its panel.
      pairs: pairs of curves to compare instead, (ours, other), in each panel of both.
      comparisons: comparisons to make instead.
      searches: searches that are trained before the curves, by their names.
      over: a field of `Curve`, or a setting, that is the x-axis of final returns, and
        the axis' label; None for learning curves. Curves whose names differ only in the
        field's value are points of one line.
      shown: names of the lines in the picture, default five of them.
      early: number of first environment steps whose mean return is compared too, as the
        curve "NAME early".
      dropped_pairs: number of pairs of curves that were compared in every panel and are
        not in the figure any more; verdicts are still corrected for them.
      solved_from: (task) -> the return of a success. If it is given, what counts is the
        share of seeds that solve the task (see `shares`), not their returns.
      floor: whether what doing nothing returns is shown, and no curve is better or
        worse than another if both return less.
    """

    title: str
    claim: str
    panels: Panels = dataclasses.field(default_factory=dict)
    favourite: str = "ppo+gasil"
    pairs: Sequence[tuple[str, str]] = ()
    comparisons: Comparisons | None = None
    searches: Mapping[str, Search] = dataclasses.field(default_factory=dict)
    over: tuple[str, str] | None = None
    shown: Sequence[str] = ()
    early: int | None = None
    dropped_pairs: int = 0
    solved_from: Callable[[str], float] | None = None
    floor: bool = False

    def curves(self) -> list[tuple[str, str, Curve]]:
        """Return all curves, each with its panel and name."""
        panels = self.panels.items()
        return [
            (panel, name, x) for panel, curves in panels for name, x in curves.items()
        ]

    def names(self, panels: Iterable[str] | None = None) -> list[str]:
        """Return the names of the curves of panels, each once; default all panels."""
        chosen = self.panels if panels is None else panels
        return list(dict.fromkeys(x for panel in chosen for x in self.panels[panel]))

    def of_kind(self, kind: str = "") -> list[str]:
        """Return the panels of a kind, or the one panel of this name.

        A kind is "dense" or "delayed" for locomotion, with "100" behind it for a delay
        that is longer than the usual one and "raw" for rewards that are not normalized,
        or "others". Of sparse tasks it is "robots" or "navix", and "noisy" for noise on
        the actions; "all robots" are with and without noise. Without a kind they are
        all panels, or the sparse ones of no such kind.
        """

        def words(panel: str) -> set[str]:
            curve = next(iter(self.panels[panel].values()))
            delayed, raw, _ = curve.family
            task = panel.removesuffix("_noisy")
            other = task.startswith(("gymnax:", "point_mass"))
            dense = self.solved_from is None and not other
            kinds = {
                "dense": dense and not delayed,
                "delayed": delayed,
                f"{curve.reward_delay}": curve.reward_delay > DELAY,
                "raw": raw,
                "others": other,
                "robots": task in SPARSE_ROBOTS,
                "navix": task.startswith("navix:"),
                "noisy": task != panel,
            }
            return {x for x, holds in kinds.items() if holds}

        if kind in self.panels:
            return [kind]
        asked, of_all = set(kind.split()), not kind and self.solved_from is None
        others = {"noisy"} if "all" in asked else set()
        return [
            x for x in self.panels if of_all or words(x) - others == asked - {"all"}
        ]

    def point_of(self, panel: str, name: str) -> tuple[str, Any]:
        """Return the name of the line that a curve belongs to, and its x value."""
        if self.over is None:
            return name, None
        curve = self.panels[panel][name]
        value = {**vars(curve), **curve.changes}[self.over[0]]
        return name.replace(f"-{value}", "", 1), value

    def compared(self) -> Comparisons:
        """Return all comparisons of the figure."""
        if self.comparisons is not None:
            every, own = self.comparisons.items(), self.panels.keys()
            return {x: terms for x, terms in every if own >= {p for _, p, _ in terms}}
        compared: dict[tuple[str, ...], Terms] = {}
        for panel, curves in self.panels.items():
            pairs = self.pairs or [
                (self.favourite, name) for name in curves if name != self.favourite
            ]
            for part in ("", " early") if self.early else ("",):
                for pair in pairs:
                    if curves.keys() >= {*pair}:
                        names = [f"{name}{part}" for name in pair]
                        compared[panel, *names] = difference(panel, *names)
        return compared

    def families(self) -> list[Comparisons]:
        """Return the comparisons by `Curve.family`; each family is corrected alone."""
        families: dict[Any, dict[tuple[str, ...], Terms]] = {}
        for key, terms in self.compared().items():
            curves = [
                self.panels[panel][name.removesuffix(" early")]
                for _, panel, name in terms
            ]
            kind = None if self.over else frozenset(x.family for x in curves)
            families.setdefault(kind, {})[key] = terms
        return list(families.values())

    def requested(self, searched: Store) -> list[Run]:
        """Return all runs of the figure whose settings are decided, panel by panel."""
        runs: list[Run] = []
        for curves in self.panels.values():
            own = [x.search for x in curves.values() if x.search]
            own = [x for x in self.searches.values() if x in own]
            runs += [run for search in own for run in search.requested(searched)]
            runs += [run for curve in curves.values() for run in curve.runs(searched)]
        runs += [run for x in self.searches.values() for run in x.requested(searched)]
        return list(dict.fromkeys(runs))


def difference(panel: str, ours: str, other: str) -> Terms:
    """Return the terms of one curve less another of the same panel."""
    return ((1.0, panel, ours), (-1.0, panel, other))


def name_of(env: str, reward_delay: int = 1) -> str:
    """Return the name of a task with its delay, such as hopper-delayed."""
    delayed = {1: "", DELAY: "-delayed"}.get(reward_delay, f"-delayed-{reward_delay}")
    return f"{env}{delayed}"


class Arm(NamedTuple):
    """A curve of each panel of a grid: its name, its agent and what it changes."""

    name: str
    agent: str
    changes: Point = types.MappingProxyType({})


def grid(
    tasks: Sequence[str],
    arms: Sequence[Arm | str],
    delays: Sequence[int] = (1,),
    *,
    panel: str = "{task}",
    curve: str = "{arm}",
    changes: Point = types.MappingProxyType({}),
    **shared: Any,
) -> Panels:
    """Return the panels of all tasks and delays, with a curve for each arm.

    Args:
      tasks: names of the tasks.
      arms: the arms; an agent's name alone is the agent without changes.
      delays: reward delays of the tasks.
      panel: name of a panel, of {task} with its delay, {env} without, and {delay}.
      curve: name of a curve, of {arm} and {delay}.
      changes: what all arms change.
      **shared: other fields of all curves.
    """
    panels: dict[str, dict[str, Curve]] = {}
    for env, delay, arm in itertools.product(tasks, delays, arms):
        name, agent, own = Arm(arm, arm) if isinstance(arm, str) else arm
        curves = panels.setdefault(
            panel.format(task=name_of(env, delay), env=env, delay=delay), {}
        )
        curves[curve.format(arm=name, delay=delay)] = Curve(
            env, agent, {**changes, **own}, delay, **shared
        )
    return panels


def joined(grids: Iterable[Panels]) -> Panels:
    """Merge the panels of several grids: panels with the same name become one."""
    panels: dict[str, dict[str, Curve]] = {}
    for name, curves in itertools.chain(*(panels.items() for panels in grids)):
        panels.setdefault(name, {}).update(curves)
    return panels
