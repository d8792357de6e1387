"""Tables of what must be refused, and the check of a command that refuses."""


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
    assert len(told) < 2000
    # Where that takes long, a line before it says what is done.
    busy = ("the environment", "the agent", "of the environment", "of the agent")
    noted = [x.startswith(("note: ", "warning: ")) or x.endswith(busy) for x in others]
    assert all(noted), printed.err
    return told
