"""Sweeps run or are refused; a point's results are those of a single run."""

import csv
import json
import os
import signal
import types

import jax
import numpy as np
import pytest
from small_training import DISCRIMINATOR_FLAGS, FLAGS

import gasil_jax
from gasil_jax import evaluate, merge, numpy_policy, plot, policy, run, sweep
from gasil_jax.errors import InputError
from gasil_jax.figures import plotting
from gasil_jax.host import run_folder, run_options
from gasil_jax.host.environments import Settings
from gasil_jax.host.members import Members
from gasil_jax.sweeps import assembly, programs, saved_states, tables
from gasil_jax.sweeps import points as sweep_points
from gasil_jax.sweeps.plan import Plan
from gasil_jax.sweeps.points import PAPER_RANGES

SMALL = (
    *(*FLAGS, "--preset", "paper", "--total-steps", "512", "--batch-steps", "256"),
    *("--minibatch-size", "64", "--num-epochs", "2", "--buffer-steps", "300"),
    *DISCRIMINATOR_FLAGS,
)


_MANY = (
    "learning_rate",
    "learning_rate_decay",
    "gamma",
    "gae_lambda",
    "clip_epsilon",
    "entropy_coefficient",
    "max_grad_norm",
    "initial_std",
    "alpha",
)


def points_of(*arguments):
    given = ["--env", "point_mass", *arguments]
    options = run_options.parse(sweep.Options, given, "x")
    run_options.check(options)
    return sweep.make_plan(options).points


def test_a_grid_is_every_combination():
    assert points_of("--grid", "buffer_steps=1e3") == points_of(
        "--grid", "buffer_steps=1000"
    )
    points = points_of("--grid", "alpha=0.1,1", "discriminator_updates=1,5")
    assert points == [
        {"alpha": 0.1, "discriminator_updates": 1},
        {"alpha": 0.1, "discriminator_updates": 5},
        {"alpha": 1.0, "discriminator_updates": 1},
        {"alpha": 1.0, "discriminator_updates": 5},
    ]


def test_random_points_are_distinct_and_of_the_papers_ranges(monkeypatch):
    many = [f"{name}=0.1,0.2,0.3,0.4,0.5,0.6" for name in _MANY]
    # Combinations are drawn, not listed: there may be too many.
    with monkeypatch.context() as patch:
        patch.setattr(sweep_points, "itertools", None)
        points = points_of("--agent", "ppo+gasil", "--random", "20", "--grid", *many)
    assert len({tuple(point.items()) for point in points}) == 20
    points = points_of("--random", "16")
    assert len({tuple(point.items()) for point in points}) == 16
    for point in points:
        assert set(point) == set(PAPER_RANGES)
        assert all(value in PAPER_RANGES[name] for name, value in point.items())


def test_points_that_vary_in_different_things_have_a_table(tmp_path, monkeypatch):
    def metrics(value):
        returns = np.array([np.nan, value, np.nan])
        return {
            "episode_return": returns,
            "episode_length": 10 * returns,
            "env_steps": np.arange(3.0),
            "skipped_updates": np.zeros(3),
        }

    training = {"env_steps": 9, "compile_seconds": 1.0, "train_seconds": 1.0}
    training |= {"device": "cpu", "device_count": 1, "versions": {}}
    points = [{"alpha": 1.0, "buffer_steps": 500}, {"learning_rate": 1e-4}]
    plan = Plan("point_mass", Settings(), gasil_jax.algorithm(), points, [5])
    trained = [
        types.SimpleNamespace(
            runs=program.runs,
            path=tmp_path / str(value),
            tables=lambda value=value: [(metrics(value), {})],
            training=training,
        )
        for program, value in zip(programs.group(plan.runs.values()), (1.0, 2.0))
    ]
    drawn = []

    def marginals(path, values, returns, *, importance, **_):
        path.touch()
        drawn.append((values, returns, importance))

    monkeypatch.setattr(plotting, "marginals", marginals)
    summary = tables.write(tmp_path, tables.read(plan, trained))
    assert summary["best_by_mean"] == 1
    assert summary["points"][1]["interquartile_mean"] == 2.0
    told = "(mean 2.0, interquartile mean 2.0, worst seed 2.0)"
    assert f"best_by_mean: learning_rate=0.0001 {told}" in tables.report(
        points, summary
    )
    # A point that does not name a value has the sweep's own.
    ((values, returns, importance),) = drawn
    assert values == {
        "alpha": [1.0, 0.1],
        "buffer_steps": [500, 1000],
        "learning_rate": [3e-4, 1e-4],
    }
    assert list(returns) == [1.0, 2.0]
    assert summary["importance"] == importance == dict.fromkeys(values)
    header, *rows = (tmp_path / "results.csv").read_text().splitlines()
    assert header == (
        "point,seed,alpha,buffer_steps,learning_rate,final_return,final_length,diverged"
    )
    assert rows == ["0,5,1.0,500,,1,10,0", "1,5,,,0.0001,2,20,0"]


def test_points_from_a_file(tmp_path):
    path = tmp_path / "points.json"
    path.write_text('[{"alpha": 1, "buffer_steps": 500}, {"learning_rate": 1e-4}]')
    points = points_of("--points-file", str(path))
    assert points == [{"alpha": 1.0, "buffer_steps": 500}, {"learning_rate": 1e-4}]
    for text, message in (
        ("[", "can't be read"),
        ("[" * 100_000, "can't be read"),
        (f'[{{"alpha": 1{"0" * 400}}}]', "it must be 0 or more and finite"),
        ("{}", "a list of points"),
        ("[3]", "3 is not a point"),
        ('[{"alhpa": 1}]', "did you mean 'alpha'"),
        ('[{"buffer_steps": 1.5}]', "buffer_steps is 1.5: it must be a whole number"),
        ('[{"alpha": 1}, {"alpha": 1.0}]', "it has {'alpha': 1} twice"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=message):
            points_of("--points-file", str(path))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--grid alhpa=1", "did you mean 'alpha'"),
        (
            "--agent ppo --grid alpha=1",
            "gail, not of ppo. What can vary: batch_steps",
        ),
        (
            "--agent ppo+sil --grid buffer_steps=9",
            "buffer_steps is a setting of ppo+bc, ppo+bc+novelty, gasil, "
            "ppo+gasil, ppo+gasil-adaptive, not of ppo+sil",
        ),
        (
            "--grid decomposition_learning_rate=1e-3,1e-4",
            "decomposition_learning_rate has no effect: decompose_rewards is off",
        ),
        ("--grid num_envs=1,2", "'num_envs' can't vary: it must be one of batch_steps"),
        ("--grid foo=1", "'foo' can't vary: it must be one of batch_steps"),
        ("--agent ppo --random 5", "random is 5: it must be at most 4"),
        ("--grid alpha=1,big", "it must be numbers, like alpha=0.1,0.2"),
        ("--grid buffer_steps=1.5", "whole numbers, like buffer_steps=10,20"),
        ("--grid alpha=0.1,-1", "alpha is -1.0"),
        ("--grid minibatch_size=64,60", "minibatch_size is 60"),
        ("--random 0", "random is 0"),
        ("--random 3 --grid alpha=0.1,0.2,0.1", "random is 3: it must be at most 2"),
        ("--grid alpha=0.02,0.1 alpha=0.2", "grid has alpha twice"),
        ("", "grid is empty"),
        ("--grid alpha=1 --shard 0/4 --out x", "shard is '0/4'"),
        ("--grid alpha=1 --shard 5/4 --out x", "shard is '5/4'"),
        ("--grid alpha=1 --shard 1/2 --out x", "1 members (points x seeds) make 1"),
        ("--grid alpha=1 --shard 1/1", "shard needs --out"),
        ("--grid alpha=1 --shards 3", "shards is 3: it needs --launcher"),
        ("--grid alpha=1 --launcher rya", "launcher is 'rya': it must be one of"),
        ("--grid alpha=1 --launcher ray --out x", "None: --launcher needs --shards"),
        ("--grid alpha=1 --launcher ray --shards 1", "launcher needs --out"),
        ("--grid alpha=1 --launcher ray --shards 2 --out x", "make 1 shards"),
        ("--grid alpha=1 --launcher ray --shards 999999999 --out x", "make 1 shards"),
    ],
)
def test_bad_input_is_one_line_and_status_2(arguments, message, capsys):
    assert sweep.main(["--env", "point_mass", *arguments.split()]) == 2
    error = capsys.readouterr().err
    assert message in error and len(error.splitlines()) == 1


def test_points_of_a_sweep_equal_single_runs(tmp_path, capsys):
    out = tmp_path / "sweep"
    arguments = (*SMALL, "--seeds", "2", "--out", str(out))
    # The last point's first step is beyond float32: it must not harm the others.
    grid = ("--grid", "learning_rate=3e-4,1e30", "discriminator_updates=1,3")
    assert sweep.main([*arguments, *grid]) == 0
    assert "best_by_mean: learning_rate=0.0003" in capsys.readouterr().out

    rows = list(csv.DictReader((out / "results.csv").open()))
    assert [(row["point"], row["seed"]) for row in rows] == [
        (str(point), str(seed)) for point in range(4) for seed in range(2)
    ]
    assert [int(row["diverged"]) for row in rows] == [0] * 4 + [1] * 4
    summary = json.loads((out / "summary.json").read_text())
    assert summary["best_by_mean"] in (0, 1)
    assert [point["diverged_seeds"] for point in summary["points"]] == [0, 0, 2, 2]
    for name in ("sweep.png", "hyperparameters.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")

    alone = tmp_path / "alone"
    more = ("--discriminator-updates", "3", "--out", str(alone))
    # As many members as a program of the sweep has, which it shares.
    assert run.main([*SMALL, "--seeds", "4", *more]) == 0
    expected = json.loads((alone / "summary.json").read_text())["final_return"]
    result = {
        row["seed"]: float(row["final_return"]) for row in rows if row["point"] == "1"
    }
    single = {seed: expected[seed] for seed in ("0", "1")}
    assert result == pytest.approx(single, rel=1e-3, abs=1e-3)
    _, algorithm, seeds, states = saved_states.load(out, point=1)
    assert algorithm.agent.discriminator_updates == 3 and seeds == [0, 1]
    _, _, _, by_itself = saved_states.load(alone)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-3),
        states.actor_critic.params,
        jax.tree.map(lambda x: np.asarray(x)[:2], by_itself.actor_critic.params),
    )
    with pytest.raises(ValueError, match="it must be 'last'"):
        saved_states.load(out, "best", point=1)
    best = saved_states.load(out)[1]
    assert best.agent.discriminator_updates == (1, 3)[summary["best_by_mean"]]
    assert evaluate.main([str(out), "--point", "4"]) == 2
    assert "has points 0 to 3" in capsys.readouterr().err
    curves = np.load(out / "curves.npz")
    assert {"env_steps", "approx_kl", "bonus"} < set(curves)
    assert all(curves[name].shape == (4, 2, 2) for name in curves)
    assert summary["env_steps_per_second"] > 0
    assert summary["device_count"] == jax.local_device_count()

    # The commands take it as they take a run, and its best policies are beside it.
    drawn = plot.read(out, point=1)
    assert drawn.final == pytest.approx([result["0"], result["1"]], rel=1e-3)
    best_seed = max(range(2), key=lambda seed: curves["episode_return"][0, seed, -1])
    env, _, _, states = saved_states.load(out, seed=best_seed)
    expected = policy.weights(states, env)
    for name, weight in numpy_policy.read(out, best_seed).items():
        np.testing.assert_allclose(weight, np.squeeze(expected[name]), rtol=1e-6)

    # A half of the points has a program for itself, of the same shapes.
    parts = tmp_path / "parts"
    where = ("--out", str(parts), "--shard")
    part = lambda number, *more: sweep.main(
        [*SMALL, "--seeds", "2", *grid, *where, f"{number}/2", *more]
    )
    assert part(2) == 0
    assert merge.main([str(parts)]) == 2
    assert "4 of 8 runs are missing" in capsys.readouterr().err
    assert part(1) == 0
    # The last one writes the tables.
    told = capsys.readouterr().out
    assert "shard 1/2 is done" in told and "best_by_mean" in told
    assert (parts / "results.csv").read_bytes() == (out / "results.csv").read_bytes()
    merged = np.load(parts / "curves.npz")
    assert set(merged) == set(curves)
    for name in curves:
        np.testing.assert_array_equal(merged[name], curves[name])
    merged = json.loads((parts / "summary.json").read_text())
    assert set(merged) == set(summary)
    for name in ("points", "best_by_mean", "best_by_worst_seed", "versions", "device"):
        assert merged[name] == summary[name]
    assert (parts / "sweep.png").read_bytes() == (out / "sweep.png").read_bytes()


def test_a_sweep_continues_with_its_own_points_from_any_file(
    tmp_path, capsys, monkeypatch
):
    first, copy, other = (tmp_path / f"{name}.json" for name in ("a", "b", "c"))
    points = [{"alpha": 0.1}, {"alpha": 1.0, "discriminator_updates": 2}]
    for path, listed in ((first, points), (copy, points), (other, points[:1])):
        path.write_text(json.dumps(listed))
    out = tmp_path / "sweep"
    out.mkdir()
    begun = [*SMALL, "--out", str(out), "--points-file", str(first)]
    options = run_options.parse(sweep.Options, begun, "x")
    run_options.write_config(options, out, points=points)

    arguments = [*SMALL, "--out", str(out), "--resume", "--points-file"]
    planned, read = [], []

    def prepare(options, jobs):
        planned.append([job.hyperparameters[0]["alpha"] for job in jobs])
        raise InputError("enough")

    original = run_folder.read
    monkeypatch.setattr(assembly, "prepare", prepare)
    monkeypatch.setattr(
        run_folder, "read", lambda folder: read.append(folder) or original(folder)
    )
    for path in (copy, other):
        assert sweep.main([*arguments, str(path)]) == 2
    # Its config.json has the points as well.
    first.unlink()
    assert sweep.main(["--resume", "--out", str(out)]) == 2
    assert planned == [[0.1, 1.0]] * 3 and read == [out] * 3
    other.unlink()
    assert sweep.main([*arguments, str(other)]) == 2
    assert "c.json, which can't be read" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("before", "more", "points"),
    [
        (["--random", "2"], ["--grid", "alpha=0.5"], 3),
        (["--grid", "alpha=0.1,0.2"], ["--random", "3"], 5),
        (["--grid", "alpha=0.1,0.2,0.3", "--random", "1"], ["--random", "3"], 3),
        (["--points-file", "a.json"], ["--grid", "alpha=0.5"], 2),
        (["--grid", "alpha=0.5"], ["--points-file", "a.json"], 2),
    ],
)
def test_a_sweep_grows_by_points_of_another_source(
    before, more, points, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.json").write_text('[{"alpha": 0.7}]')
    options = run_options.parse(sweep.Options, [*SMALL, "--out", "s", *before], "x")
    (tmp_path / "s").mkdir()
    plan = sweep.make_plan(options)
    run_options.write_config(options, tmp_path / "s", points=plan.points)
    planned = []

    def prepare(options, jobs):
        planned.append(options)
        raise InputError("enough")

    monkeypatch.setattr(assembly, "prepare", prepare)
    assert sweep.main(["--resume", "--out", "s", *more]) == 2
    stored = run_folder.read(tmp_path / "s")
    assert len(sweep.make_plan(planned[0], stored).points) == points


def test_an_interrupted_sweep_continues(tmp_path, monkeypatch, capsys):
    long = (*FLAGS, "--agent", "ppo", "--total-steps", str(60 * 128), "--seeds", "2")
    grid = ("--grid", "gamma=0.9,0.99", "num_epochs=1,2")
    whole, out = tmp_path / "whole", tmp_path / "interrupted"
    assert sweep.main([*long, *grid, "--out", str(whole)]) == 0
    train = Members.train

    def interrupt(program, at_least, arguments):
        """Send SIGTERM in a program's chunk that ends there or later."""

        def interrupted(self, advance, states, first, count):
            number = self.config.num_epochs - 1
            if number == program and first + count >= at_least:
                os.kill(os.getpid(), signal.SIGTERM)
            return train(self, advance, states, first, count)

        with monkeypatch.context() as patch:
            patch.setattr(Members, "train", interrupted)
            assert sweep.main(arguments) == 128 + signal.SIGTERM
        assert f"gasil_jax.sweep --resume --out {out}" in capsys.readouterr().err
        assert not (out / "results.csv").exists()

    # In the last chunk of a program, and so before the next one has begun.
    interrupt(0, 60, [*long, *grid, "--out", str(out)])
    (first,) = (out / "programs").iterdir()
    # In the second program, after some chunks.
    interrupt(1, 30, ["--resume", "--out", str(out)])
    seconds = (first / "training.json").read_bytes()
    assert sweep.main(["--resume", "--out", str(out)]) == 0
    assert (out / "results.csv").read_bytes() == (whole / "results.csv").read_bytes()
    # The first program was finished, and is left as it was.
    assert (first / "training.json").read_bytes() == seconds
