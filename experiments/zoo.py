"""The trained policies that the package comes with: ``python -m experiments zoo RUN``.

From each run, the policy of the seed with the highest return in training is scored in
Gymnasium. It replaces the package's policy for the task if its score is higher. The
table in docs/data.md is written from the policies.
"""

import dataclasses
import json
import pathlib
from typing import Any

import numpy as np

from experiments import report, tables
from experiments.curves import name_of
from gasil_jax import npz, numpy_policy
from gasil_jax.cli.parsing import POSITIONAL, check_minimum, input_checked
from gasil_jax.errors import InputError
from gasil_jax.evaluation import evaluate_in_gymnasium
from gasil_jax.host import environments, output_file, sweep

TABLE = pathlib.Path(__file__).parent.parent / "docs" / "data.md"


@dataclasses.dataclass(frozen=True)
class Options:
    """Score runs' best policies and add them to the package's.

    Attributes:
      runs: folders of finished runs on locomotion tasks.
      episodes: episodes of each score.
    """

    runs: tuple[pathlib.Path, ...] = dataclasses.field(metadata=POSITIONAL)
    episodes: int = 100


def add(folder: pathlib.Path, episodes: int, zoo: pathlib.Path) -> str:
    """Score a run's best policy; if it is the best on its task, keep it in `zoo`."""
    trained = sweep.read(folder)
    algorithm, delay = trained.algorithm, trained.settings.reward_delay
    with input_checked():
        env = environments.make_env(trained.env)
        saved = npz.read(folder / "policy.npz")
    if not environments.is_locomotion(env):
        raise InputError(f"run is {folder}: it must be of a locomotion task")
    final = np.nan_to_num(saved["final_return"], nan=-np.inf)
    best = int(np.argmax(final))
    if not np.isfinite(final[best]):
        raise InputError(f"run is {folder}: none of its seeds ended an episode")
    seed = int(saved["seeds"][best])
    weights = numpy_policy.read(folder, seed)
    returns = evaluate_in_gymnasium(
        env.unwrapped.task.gymnasium_id,
        numpy_policy.make(weights),
        num_episodes=episodes,
    )["episode_return"]
    about = {
        "env": trained.env,
        "reward_delay": delay,
        "agent": algorithm.agent.name,
        "decompose_rewards": algorithm.settings["decompose_rewards"],
        "seed": seed,
        "env_steps": algorithm.config.total_steps,
        "mean": round(float(returns.mean()), 1),
        "deviation": round(float(returns.std()), 1),
        "episodes": episodes,
    }
    path = zoo / f"{name_of(trained.env, delay)}.npz"
    words = f"{path.stem}: {about['mean']} in Gymnasium"
    if path.exists():
        before = json.loads(str(npz.read(path)["about"]))["mean"]
        if before >= about["mean"]:
            return f"{words}; the stored policy has {before} and stays"
        words += f", before {before}"
    arrays: dict[str, Any] = {
        "about": np.array(json.dumps(about)),
        "seeds": np.array([seed]),
        "final_return": np.array([final[best]]),
        **{x: v if x in numpy_policy.SHARED else v[None] for x, v in weights.items()},
    }
    zoo.mkdir(exist_ok=True)
    with output_file.atomic(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, **arrays)
    return words


def table() -> str:
    """Return a table of the policies that the package comes with."""
    rows = []
    for name in numpy_policy.zoo():
        about = numpy_policy.about(f"{numpy_policy.ZOO_PREFIX}{name}")
        score = f"{about['mean']:,.0f} ± {about['deviation']:,.0f}"
        steps = f"{about['env_steps']:,}"
        agent = about["agent"] + " (decomposed)" * about["decompose_rewards"]
        rows.append([f"`zoo:{name}`", agent, steps, score])
    head = ["policy", "trained with", "steps", "return in Gymnasium"]
    return tables.markdown_table(head, rows)


def run(options: Options) -> None:
    """Add the best policies of runs, and write the table."""
    check_minimum(options, episodes=1)
    for folder in options.runs:
        print(add(folder, options.episodes, numpy_policy.ZOO), flush=True)
    text = report.fill_blocks(TABLE.read_text(), lambda _: table())
    with output_file.atomic(TABLE) as partial:
        partial.write_text(text)
    print(f"in {TABLE}")
