"""The pages of figures: the text of ``notes/NAME.md`` with its slots filled in.

A slot is {{NAME ARGUMENTS}}; see `tables.SLOTS`.
"""

import functools
import pathlib
import re
import shlex
from collections.abc import Callable

from experiments import plots, tables
from experiments.figure_results import Results
from gasil_jax.errors import InputError
from gasil_jax.host import output_file

NOTES = pathlib.Path(__file__).parent / "notes"


def note(name: str) -> str:
    """Return the text of a page, with its slots."""
    return (NOTES / f"{name}.md").read_text()


def fill(text: str, value: Callable[..., str]) -> str:
    """Fill the slots of a text with the results of `value`."""
    return re.sub(r"{{(.+?)}}", lambda x: value(*shlex.split(x[1])), text)


def fill_blocks(text: str, value: Callable[..., str]) -> str:
    """Replace the text between ``<!-- begin SLOT -->`` and ``<!-- end -->``."""
    block = re.compile(r"(<!-- begin (.+?) -->\n).*?(<!-- end -->)", re.DOTALL)
    return block.sub(lambda x: f"{x[1]}\n{value(*shlex.split(x[2]))}\n\n{x[3]}", text)


@functools.cache
def value(results: Results, slot: str, *arguments: str) -> str:
    """Return the text of a slot; the summaries have many of a page's slots too.

    Raises:
      InputError: if there is no such slot.
    """
    if slot not in tables.SLOTS:
        raise InputError(f"slot is {slot}: it must be one of {', '.join(tables.SLOTS)}")
    return tables.SLOTS[slot](results, *arguments) or "Nothing is complete yet."


def page(name: str, results: Results, text: str) -> str:
    """Return the page of a figure as Markdown; `text` has slots."""
    figure, parts = results.figure, [f"# {results.figure.title}"]
    if figure.claim:
        parts.append(f"**The paper's claim.** {figure.claim}")
    filled = [fill(text, functools.partial(value, results)).strip()]
    picture = [f"![{name}]({name}.png)"] if results.curves else []
    parts += [*picture, *filled] if figure.claim else [*filled, *picture]
    total = sum(curve.seeds for _, _, curve in figure.curves())
    if missing := total - sum(len(one.records) for one in results.curves.values()):
        words = f"Not trained yet: {missing} of {total} runs"
        store, searches = results.searched, figure.searches.values()
        runs = [run for search in searches for run in search.requested(store)]
        if searched := len(store.missing(runs)):
            words += f", and at least {searched} of the searches"
        parts.append(f"{words}.")
    if results.curves:
        dropped = figure.dropped_pairs * len(figure.panels)
        sizes = " and ".join(f"{len(x) + dropped}" for x in figure.families())
        reading = note("how_to_read_shares" if figure.solved_from else "how_to_read")
        parts += [fill(reading, lambda _: sizes).strip(), "## Settings"]
        parts.append(tables.settings(results))
    return "\n\n".join(parts) + "\n"


def write(
    name: str, results: Results, folder: pathlib.Path, text: str | None = None
) -> None:
    """Write the page of a figure and its plot; `text` is by default its note."""
    folder.mkdir(parents=True, exist_ok=True)
    if results.curves:
        records = {k: list(x.records.values()) for k, x in results.curves.items()}
        picture = plots.draw(results.figure, records, results.scores)
        plots.save_png(picture, folder / f"{name}.png")
    with output_file.atomic(folder / f"{name}.md") as partial:
        partial.write_text(page(name, results, note(name) if text is None else text))
