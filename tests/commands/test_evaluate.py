"""Saving, loading and scoring a run's policies."""

import csv
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs import Wrapper
from small_training import FLAGS

import gasil_jax
from gasil_jax import evaluate, evaluation, numpy_policy, policy, run
from gasil_jax.host import checkpoint

# With the other tests that use it, so that it is trained once.
pytestmark = pytest.mark.xdist_group("trained_point_mass")


def test_gymnasiums_episodes_have_the_runs_limit():
    rest = lambda observation: np.zeros(2)
    for limit, length in ((7, 7), (None, 1000)):
        scores = evaluate.evaluate_in_gymnasium(
            "Swimmer-v5", rest, num_episodes=1, num_steps=limit
        )
        assert scores["episode_length"] == [length]


def test_a_state_of_another_shape_is_refused(trained_point_mass, tmp_path):
    _, _, states = trained_point_mass
    checkpoint.save(tmp_path / "state", states)
    other = jax.eval_shape(lambda: jax.tree.map(lambda x: x[:1], states))
    with pytest.raises(ValueError, match="holds another state"):
        checkpoint.restore(tmp_path / "state", other)
    with pytest.raises(ValueError, match="holds another state"):
        checkpoint.restore(tmp_path / "state", other.replace(agent=()))


def test_scores_are_those_of_a_plain_loop(trained_point_mass):
    env, algorithm, states = trained_point_mass
    state = gasil_jax.member(states, 1)
    key = jax.random.key(3)
    scores = jax.jit(
        lambda s: evaluation.evaluate(env, algorithm, s, key=key, num_episodes=3)
    )(state)
    act = numpy_policy.make(policy.weights(state, env))
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    for i, reset_key in enumerate(jax.random.split(jax.random.split(key)[0], 3)):
        running, total, length = reset(reset_key), 0.0, 0
        while not running.done:
            running = step(running, jnp.asarray(act(np.asarray(running.obs))))
            total += float(running.info["true_reward"])
            length += 1
        np.testing.assert_allclose(scores["episode_return"][i], total, rtol=1e-3)
        assert int(scores["episode_length"][i]) == length == 50


def test_stochastic_scores_vary_more(trained_point_mass):
    env, algorithm, states = trained_point_mass

    @functools.partial(jax.jit, static_argnums=1)
    def score(states, deterministic):
        return evaluation.evaluate(
            env,
            algorithm,
            gasil_jax.member(states, 0),
            key=jax.random.key(0),
            num_episodes=50,
            deterministic=deterministic,
        )["episode_return"]

    assert np.std(score(states, False)) > np.std(score(states, True))


def test_one_seed_scores_as_with_all_and_every_episode_is_written(tmp_path, capsys):
    folder = str(tmp_path / "run")
    arguments = (*FLAGS, "--agent", "ppo", "--seeds", "2", "--first-seed", "4")
    assert run.main([*arguments, "--out", folder]) == 0
    capsys.readouterr()
    out = tmp_path / "new" / "scores.csv"
    flags = ["--episodes", "3", "--stochastic"]
    assert evaluate.main([folder, *flags, "--out", str(out)]) == 0
    lines = capsys.readouterr().out.splitlines()
    with out.open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["seed"], row["episode"]) for row in rows] == [
        (seed, episode) for seed in ("4", "5") for episode in "012"
    ]
    for line, seed in zip(lines[1:3], "45", strict=True):
        returns = [float(row["episode_return"]) for row in rows if row["seed"] == seed]
        assert line.split()[2] == f"{np.mean(returns):.2f}"
    assert {row["episode_length"] for row in rows} == {"50"}
    assert evaluate.main([folder, *flags, "--seed", "5"]) == 0
    assert capsys.readouterr().out.splitlines()[1] == lines[2]
    # Nothing is written over, and what can't be scored is refused before it is.
    for arguments, message in (
        (("--out", str(out)), "which exists: name a new file"),
        (("--out", str(out.with_suffix(".txt"))), "it must end in .csv"),
        (("--out", str(out / "x.csv")), "can't be written"),
        (("--out", "/proc/scores.csv"), "/proc/scores.csv, which can't be written"),
        (("--seed", "6"), "seed is 6: the run has 4 to 5"),
    ):
        assert evaluate.main([folder, *arguments]) == 2
        error = capsys.readouterr().err
        assert message in error and len(error.splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "PATH is missing: see --help"),
        (("x", "--checkpoint", "first"), "checkpoint is 'first': it must be one of la"),
    ],
)
def test_a_wrong_command_line_is_one_line(arguments, message, capsys):
    assert evaluate.main(arguments) == 2
    (error,) = capsys.readouterr().err.splitlines()
    assert message in error


def test_an_episode_that_is_only_cut_off_ends_too(trained_point_mass):
    """As in training; `done` need not be set beside `truncation`."""
    env, algorithm, states = trained_point_mass

    class CutOff(Wrapper):
        def reset(self, rng):
            state = self.env.reset(rng)
            info = {"time": jnp.int32(0), "truncation": jnp.float32(0)}
            return state.replace(info={**state.info, **info})

        def step(self, state, action):
            time = state.info["time"] + 1
            stepped = self.env.step(state, action)
            cut_off = jnp.where(time == 7, 1.0, 0.0)
            info = {**stepped.info, "time": time, "truncation": cut_off}
            return stepped.replace(info=info, done=jnp.zeros_like(stepped.done))

    key, state = jax.random.key(0), gasil_jax.member(states, 0)
    scores = jax.jit(
        lambda s: evaluation.evaluate(
            CutOff(env), algorithm, s, key=key, num_episodes=3
        )
    )(state)
    assert scores["episode_length"].tolist() == [7, 7, 7]
