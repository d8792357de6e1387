"""Command line: ``python -m gasil_jax.run --env walker2d --seeds 10``.

Parses, drives the training loop in chunks, logs and saves. No algorithm is here.
"""

import contextlib
import dataclasses
import pathlib
import sys
import time
from collections.abc import Sequence
from typing import Annotated, Any, TypeVar

import jax
import numpy as np
import tyro

from gasil_jax import command_line, environments, presets
from gasil_jax import train as training
from gasil_jax.command_line import InputError
from gasil_jax.config import Config, unknown, validate
from gasil_jax.environments import Settings
from gasil_jax.imitation import AGENTS


@dataclasses.dataclass(frozen=True)
class Options:
    """Train an agent on an environment, many seeds at once.

    Attributes:
      env: environment: point_mass, hopper, walker2d, halfcheetah, swimmer, ant or
        humanoid.
      seeds: how many seeds.
      first_seed: number of the first seed; a seed's result depends on its number
        alone.
      out: run folder, created here; default runs/ENV-AGENT-TIME.
      preset: where the hyperparameters start from: tuned, by environment and agent,
        or paper; flags override it.
      devices: host devices that the seeds are sharded over; default the cores.
      settings: of the environment.
      config: the algorithm.
    """

    env: str
    seeds: int = 1
    first_seed: int = 0
    out: pathlib.Path | None = None
    preset: str = "tuned"
    devices: int | None = None
    settings: Annotated[Settings, tyro.conf.arg(name="")] = dataclasses.field(
        default_factory=Settings
    )
    config: Annotated[Config, tyro.conf.arg(name="")] = dataclasses.field(
        default_factory=Config
    )


T = TypeVar("T", bound=Options)


def parse(kind: type[T], arguments: Sequence[str] | None, program: str) -> T:
    """Options from the command line, on top of the preset that they name.

    Raises:
      InputError: a flag or value that is unknown.
    """
    given = command_line.parse(kind, arguments, program)
    if given.preset not in presets.names():
        raise InputError(unknown("preset", given.preset, presets.names()))
    config = presets.preset(given.env, given.config.agent, given.preset)
    default = kind(env=given.env, config=config)
    return command_line.parse(kind, arguments, program, default)


def check(options: Options) -> None:
    """Refuse bad input before anything is built or compiled.

    Raises:
      InputError: the value and what is allowed.
    """
    try:
        environments.check(options.env, options.settings)
        validate(options.config, tuple(AGENTS))
    except ValueError as error:
        raise InputError(str(error)) from None
    if options.seeds < 1:
        raise InputError(f"seeds is {options.seeds}: it must be 1 or more")
    last = 2**32 - options.seeds
    if not 0 <= options.first_seed <= last:
        raise InputError(
            f"first_seed is {options.first_seed}: it must be from 0 to {last}"
        )
    if options.devices is not None and options.devices < 1:
        raise InputError(f"devices is {options.devices}: it must be 1 or more")


def make_run_folder(options: Options) -> pathlib.Path:
    """Create the run folder; one that holds anything is refused.

    Raises:
      InputError: it is used or can't be written.
    """
    folder = options.out
    if folder is None:
        stamp = time.strftime("%Y%m%d-%H%M%S")
        folder = pathlib.Path("runs", f"{options.env}-{options.config.agent}-{stamp}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise InputError(
                f"out is {folder}, which is not empty: name a new or an empty folder"
            )
        probe = folder / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(
            f"out is {folder}, which can't be written: {error.strerror}"
        ) from None
    return folder


def use_devices(options: Options, num_members: int) -> None:
    """Settings that must stand before JAX starts."""
    count = min(options.devices or environments.available_cores(), num_members)
    environments.prepare(options.settings, count)
    # In a program that has used JAX already, its devices stay as they are.
    with contextlib.suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", count)
    # TF32 has ruined PPO runs on Ampere and later GPUs.
    jax.config.update("jax_default_matmul_precision", "highest")


def write_config(options: Options, folder: pathlib.Path, **more: Any) -> None:
    """Write config.json: every option, the config's fields under "config"."""
    from gasil_jax import logging

    described = {f.name: getattr(options, f.name) for f in dataclasses.fields(options)}
    described |= {"out": str(folder)}
    logging.write_json(folder / "config.json", described | more)


def make_env(options: Options) -> Any:
    """The environment that the options ask for.

    Raises:
      InputError: the agent can't run in it.
    """
    env = environments.make_env(options.env, **dataclasses.asdict(options.settings))
    try:
        training.check(env, options.config)
    except ValueError as error:
        raise InputError(str(error)) from None
    return env


def train(options: Options, env: Any, folder: pathlib.Path) -> dict[str, Any]:
    """Train, log and save; returns the summary."""
    from gasil_jax import batch, checkpoint, logging, plotting
    from gasil_jax.progress import Progress

    config = options.config
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    write_config(options, folder)
    total_steps = config.num_iterations * config.batch_steps * options.seeds
    writer = logging.MetricsWriter(folder / "metrics.csv", seeds)
    history: list[dict[str, np.ndarray]] = []
    with Progress(f"{options.env} {config.agent}", total_steps) as progress:
        progress.phase("compiling")
        started = time.monotonic()
        runs = batch.make_batch(env, config, seeds)
        states, advance = runs.compile()
        compile_seconds = time.monotonic() - started

        progress.phase("training")
        started = time.monotonic()
        for latest in runs.run(states, advance):
            states, metrics = latest
            writer.write(metrics)
            history.append(metrics)
            progress.update(
                int(metrics["env_steps"][:, -1].sum()), metrics["episode_return"]
            )
        train_seconds = time.monotonic() - started
    writer.close()
    checkpoint.save(folder / "checkpoint", runs.trim(states))

    returns = np.concatenate([m["episode_return"] for m in history], axis=1)
    steps = np.concatenate([m["env_steps"][0] for m in history])
    faulty = sum(m["faulty_steps"].sum(axis=1) for m in history)
    plotting.learning_curve(
        folder / "learning_curve.png", steps, returns, f"{options.env}, {config.agent}"
    )
    final = final_returns(returns)
    summary = {
        "env": options.env,
        "agent": config.agent,
        "env_steps_per_seed": int(steps[-1]),
        "final_return": {
            str(seed): None if np.isnan(value) else float(value)
            for seed, value in zip(seeds, final, strict=True)
        },
        "final_return_mean": None
        if np.isnan(final).all()
        else float(np.nanmean(final)),
        "faulty_steps": {
            str(seed): int(n) for seed, n in zip(seeds, faulty, strict=True)
        },
        "compile_seconds": compile_seconds,
        "train_seconds": train_seconds,
        "env_steps_per_second": total_steps / train_seconds,
        "device": f"{len(runs.devices)} x {runs.devices[0].device_kind}",
        "versions": logging.versions(),
    }
    logging.write_json(folder / "summary.json", summary)
    return summary


def final_returns(returns: np.ndarray) -> np.ndarray:
    """Each seed's mean return over the last tenth of iterations, (seeds,).

    NaN where no episode ended in that time.
    """
    last = returns[:, -max(1, returns.shape[1] // 10) :]
    count = np.isfinite(last).sum(axis=1)
    total = np.nansum(last, axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    try:
        options = parse(Options, arguments, "gasil_jax.run")
        check(options)
        use_devices(options, options.seeds)
        env = make_env(options)
        folder = make_run_folder(options)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    summary = train(options, env, folder)
    mean = summary["final_return_mean"]
    print(
        f"final return {'none ended' if mean is None else format(mean, '.1f')} "
        f"(mean over {options.seeds} seeds), "
        f"{summary['env_steps_per_second']:,.0f} steps/s, in {folder}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
