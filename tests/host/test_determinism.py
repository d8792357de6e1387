"""What a seed's result does not depend on, from the command line."""

import csv

import numpy as np
from test_resume import SMALL, finish, start

BASE = (
    *SMALL,
    "--agent",
    "ppo+gasil",
    "--total-steps",
    str(10 * 128),
    "--seeds",
    "4",
    "--first-seed",
    "5",
)

# A batch of another size is vectorized in another order, so sums are rounded in
# another order; ten iterations of learning let that grow.
RELATIVE, ABSOLUTE = 2e-3, 2e-4


def results(tmp_path, *variants):
    """The bytes of metrics.csv of runs side by side."""
    contents = []
    for first in range(0, len(variants), 2):
        children = []
        for number, more in enumerate(variants[first : first + 2]):
            out = tmp_path / f"{first + number}"
            children.append((out, start(out, *BASE, *more)))
        for out, child in children:
            status, _, err = finish(child)
            assert status == 0, err
            contents.append((out / "metrics.csv").read_bytes())
    return contents


def by_seed(content):
    table = {}
    for row in csv.DictReader(content.decode().splitlines()):
        numbers = [float(x) if x else np.nan for x in list(row.values())[1:]]
        table.setdefault(row["seed"], []).append(numbers)
    return {seed: np.array(numbers) for seed, numbers in table.items()}


def test_a_seeds_result_is_its_own(tmp_path):
    # The second finds the first's program in the cache: they don't run side by side.
    one, two, again, alone = results(
        tmp_path,
        ("--devices", "1"),
        ("--devices", "2"),
        ("--devices", "1"),
        ("--devices", "1", "--first-seed", "7", "--seeds", "1"),
    )
    assert one == again
    expected = by_seed(one)
    assert set(expected) == {"5", "6", "7", "8"} and set(by_seed(alone)) == {"7"}
    for other in (two, alone):
        for seed, numbers in by_seed(other).items():
            difference = np.abs(numbers - expected[seed])
            print(seed, np.nanmax(difference / (1e-3 + np.abs(expected[seed]))))
            np.testing.assert_allclose(
                numbers, expected[seed], rtol=RELATIVE, atol=ABSOLUTE
            )
    # Seeds differ.
    assert np.nanmax(np.abs(expected["5"] - expected["6"])) > 0.1
