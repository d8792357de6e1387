"""Tables of what must be refused, and the check of a command that refuses."""

import re


def rows(text):
    """Return the rows of a table, whose cells are apart by ` | `."""
    lines = text.strip("\n").splitlines()
    return [[cell.strip() for cell in f"{x} ".split(" | ")] for x in lines]


def refused(capsys, program, *words):
    """Run a command that must end in one line and with status 2; return the line."""
    capsys.readouterr()
    status = program.main(list(map(str, words)))
    printed = capsys.readouterr()
    *others, told = printed.err.splitlines()
    assert status == 2 and told.startswith("error: ") and printed.out == "", words
    # Where that takes long, lines before it say what is being done.
    assert all(re.match(r"note: |warning: |.*: \w+ing ", x) for x in others), others
    return told
