"""Two ways around a wall: the given episodes, and what is counted."""

import csv

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gasil_jax
from experiments import __main__, two_doors
from experiments.search import SPARSE
from gasil_jax import export_minari
from gasil_jax.buffer import GoodTrajectories


def test_it_has_no_part_in_the_comparison_of_sparse_tasks():
    assert two_doors.ENV not in SPARSE


def test_half_of_the_given_episodes_reach_the_goal_on_each_side():
    env = gasil_jax.make_env(two_doors.ENV)
    buffer = two_doors.Cloning().init(jax.random.key(0), None)
    # Of a full buffer the last episode may be cut, and is not counted.
    ways = two_doors.ways_of_buffer(env, buffer)
    np.testing.assert_allclose(ways, [256 / 511, 255 / 511])
    step, time = jax.jit(env.step), two_doors.demonstrations()[2]
    state = env.reset(jax.random.key(0))
    for action in buffer.action[: np.flatnonzero(time == 0)[1]]:
        assert not state.done
        state = step(state, action)
    assert state.reward == env.unwrapped.solved


@pytest.mark.parametrize("xp", [np, jnp])
@pytest.mark.parametrize(("across", "side"), [((0.1, -0.5, 0.3), -1), ((0, 0.2), 1)])
def test_the_side_is_where_an_episode_is_farthest_from_the_middle(xp, across, side):
    assert two_doors.side(xp.array(across), xp) == side


def test_a_buffers_failures_take_no_way():
    """Two episodes of two steps, and one that failed; the last steps are empty."""
    env = gasil_jax.make_env(two_doors.ENV)
    across = np.array([0.0, 0.5, 0.0, -0.5, 0.1, 0.6, 0.0, 0.0], np.float32)
    buffer = GoodTrajectories(
        observation=np.stack([np.zeros(8, np.float32), across, np.ones(8)], axis=1),
        action=np.zeros((8, 2), np.float32),
        return_=np.array([0.9, 0.9, 0.8, 0.8, 0.0, 0.0, 0.0, 0.0]),
        time=np.array([0, 1, 0, 1, 0, 1, 0, 0]),
        size=np.int32(6),
    )
    assert len(export_minari.episodes(buffer, 25)) == 3
    np.testing.assert_allclose(two_doors.ways_of_buffer(env, buffer), [1 / 3, 1 / 3])
    assert np.isnan(two_doors.ways_of_buffer(env, buffer.replace(size=0))).all()


def rows(drawn, likely, buffer):
    return [
        {"agent": "one", "policy_components": 4, "seed": seed}
        | {
            f"{column} {word}": share
            for column, ways in zip(two_doors._COLUMNS, shares, strict=True)
            for word, share in zip(("left", "right"), ways, strict=True)
        }
        for seed, shares in enumerate(zip(drawn, likely, buffer, strict=True))
    ]


def test_the_table_counts_seeds():
    nan = float("nan")
    counted = rows(
        drawn=[(0.5, 0.45), (1.0, 0.0), (0.3, 0.3), (0.0, 0.0)],
        likely=[(1.0, 0.0), (1.0, 0.0), (0.0, 0.0), (0.0, 0.0)],
        buffer=[(0.5, 0.5), (1.0, 0.0), (0.5, 0.5), (0.5, 0.05)],
    )
    last = two_doors.table(counted).splitlines()[-1]
    assert last == "| one | 4 | 4 | 0.50 | 0.50 | 0.64 | 0.50 | 0.50 | 0.50 | 0.75 |"
    for row in counted:
        row |= {"buffer left": nan, "buffer right": nan}
    assert two_doors.table(counted).endswith("| 0.50 | - | - |")


def test_both_tables_are_written_and_a_second_call_trains_nothing(
    tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(two_doors, "COMPONENTS", (4,))
    runs, out = tmp_path / "runs", tmp_path / "out"
    arguments = (
        "--seeds",
        "2",
        "--total-steps",
        "2048",
        "--only",
        *two_doors.AGENTS_OF,
    )
    arguments = [*arguments[:6], "--runs", str(runs), "--out", str(out)]
    for _ in range(2):
        assert __main__.main(["two_doors", *arguments]) == 0
        with (out / "two_doors.csv").open(newline="") as file:
            counted = list(csv.DictReader(file))
        assert [(x["policy_components"], x["seed"]) for x in counted] == [
            *(("4", "0"), ("4", "1"))
        ]
        assert {float(x["buffer right"]) for x in counted} == {0.499}
    printed = capsys.readouterr().out
    assert (out / "two_doors.md").read_text().strip().splitlines()[-1] in printed
