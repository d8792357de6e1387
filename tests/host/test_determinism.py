"""A seed's result does not depend on devices, other seeds or the process."""

import csv

import numpy as np
from test_resume import SMALL, finish, start

from gasil_jax import run

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


def by_seed(content):
    table = {}
    for row in csv.DictReader(content.decode().splitlines()):
        numbers = [float(x) if x else np.nan for x in list(row.values())[1:]]
        table.setdefault(row["seed"], []).append(numbers)
    return {seed: np.array(numbers) for seed, numbers in table.items()}


def test_a_seeds_result_is_its_own(tmp_path):
    """Compare four seeds on two devices, the same in another process, and one seed."""
    here, again, alone = (tmp_path / name for name in ("here", "again", "alone"))
    both = ("--devices", "2")
    assert run.main([*BASE, *both, "--out", str(here)]) == 0
    status, _, err = finish(start(again, *BASE, *both))
    assert status == 0, err
    of_one = ("--devices", "1", "--first-seed", "7", "--seeds", "1")
    assert run.main([*BASE, *of_one, "--out", str(alone)]) == 0
    contents = [(out / "metrics.csv").read_bytes() for out in (here, again, alone)]
    assert contents[0] == contents[1]
    expected, other = by_seed(contents[0]), by_seed(contents[2])
    assert set(expected) == {"5", "6", "7", "8"} and set(other) == {"7"}
    difference = np.abs(other["7"] - expected["7"])
    print(np.nanmax(difference / (1e-3 + np.abs(expected["7"]))))
    np.testing.assert_allclose(other["7"], expected["7"], rtol=RELATIVE, atol=ABSOLUTE)
    # Seeds differ.
    assert np.nanmax(np.abs(expected["5"] - expected["6"])) > 0.1
