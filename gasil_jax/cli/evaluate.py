"""Evaluate the policies of a run: ``python -m gasil_jax.evaluate RUN``."""

import csv
import dataclasses
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from gasil_jax import numpy_policy, policy, statistics
from gasil_jax.cli.parsing import check_minimum, read
from gasil_jax.cli.policies import PolicyOptions
from gasil_jax.cli.reporting import reports_errors
from gasil_jax.errors import InputError
from gasil_jax.evaluation import evaluate_in_gymnasium, run_episodes
from gasil_jax.host import environments, output_file, resources
from gasil_jax.host.progress import announced
from gasil_jax.host.saved import Policies


@dataclasses.dataclass(frozen=True)
class Options(PolicyOptions):
    """Evaluate the policies of a run, or of a point of a sweep.

    Attributes:
      seed: evaluate only this seed; default all seeds.
      episodes: number of episodes for each seed.
      gymnasium: evaluate in Gymnasium, with C MuJoCo, without delay and noise. Only for
        locomotion, and not with stochastic.
      out: new CSV file, to which the return and length of each episode are written.
    """

    seed: int | None = None
    episodes: int = 20
    gymnasium: bool = False
    out: pathlib.Path | None = None


def _score(options: Options, policies: Policies) -> dict[str, np.ndarray]:
    def score(weights: Any, key: jax.Array) -> dict[str, jax.Array]:
        return run_episodes(
            policies.env,
            policy.make(weights),
            key,
            num_episodes=options.episodes,
            num_steps=policies.num_steps,
            deterministic=not options.stochastic,
        )

    # A seed has the same starts and draws whether evaluated alone or with others.
    def fold(seed: jax.Array) -> jax.Array:
        return jax.random.fold_in(jax.random.key(options.key), seed)

    keys = jax.jit(jax.vmap(fold))(np.array(policies.seeds, np.uint32))
    weights = jax.tree.map(lambda *x: np.stack(x), *policies.weights)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(score))(weights, keys))


def _score_in_gymnasium(options: Options, policies: Policies) -> dict[str, np.ndarray]:
    scores = [
        evaluate_in_gymnasium(
            policies.env.unwrapped.task.gymnasium_id,
            numpy_policy.make(weights),
            num_episodes=options.episodes,
            seed=options.key,
            num_steps=policies.num_steps,
        )
        for weights in policies.weights
    ]
    return jax.tree.map(lambda *x: np.stack(x), *scores)


@reports_errors
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    options = read(Options, arguments, "gasil_jax.evaluate")
    check_minimum(options, episodes=1)
    if options.out is not None:
        output_file.check(options.out, (".csv",))
    policies = options.load(options.seed)
    env, seeds = policies.env, policies.seeds
    if options.gymnasium and not (
        environments.is_locomotion(env)
        and env.unwrapped.task.gymnasium_id
        and env.observation_size == env.unwrapped.observation_size
        and not options.stochastic
    ):
        raise InputError(
            "gymnasium is on: the run must be of a locomotion task of Gymnasium, "
            "without observe_phase, and stochastic must be off"
        )
    if not options.gymnasium:
        resources.check_episodes(env, options.episodes, len(seeds), jax.devices()[:1])
    if options.out is not None:
        output_file.make_parent(options.out)
    jax.config.update("jax_default_matmul_precision", "highest")
    with announced("evaluate", f"running {options.episodes} episodes per seed"):
        score = _score_in_gymnasium if options.gymnasium else _score
        scores = score(options, policies)
    print("seed  episodes      return        std  length")
    for i, seed in enumerate(seeds):
        returns, length = scores["episode_return"][i], scores["episode_length"][i]
        print(
            f"{seed:4d}  {options.episodes:8d}  {returns.mean():10.2f} "
            f"{returns.std():10.2f}  {length.mean():6.1f}"
        )
    over_seeds = {"return": scores["episode_return"].mean(axis=1)}
    print(statistics.in_words(over_seeds))
    if options.out is not None:
        _write(options.out, seeds, scores)
        print(f"in {options.out}")
    return 0


def _write(
    path: pathlib.Path, seeds: Sequence[int], scores: Mapping[str, np.ndarray]
) -> None:
    """Write a row for each episode."""
    with output_file.atomic(path) as partial, partial.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["seed", "episode", *scores])
        for index, seed in enumerate(seeds):
            columns = [values[index].tolist() for values in scores.values()]
            for episode, values in enumerate(zip(*columns, strict=True)):
                writer.writerow([seed, episode, *values])
