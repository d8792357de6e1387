"""Speed and fidelity: ``python -m experiments benchmark``.

Tables, and the same as JSON. "physics": each way of building a task, random actions
under jit, vmap and scan, with the relative error of one step (the worst entry of the
observation, median over the environments) against C MuJoCo with the model's own
integrator, which is Gymnasium's. "training": whole PPO+GASIL, many seeds at once,
beside the physics alone with as many environments, and beside Stable-Baselines3's PPO
on Gymnasium's task where that is installed (the extra "benchmark"): one process, and
one on every core. "scaling", if asked for: that training on 1, 2, 4 ... devices, each
with as many seeds: a perfect ratio is the number of devices.

All rows of a task are compiled first and then timed in turn, again and again, so that a
ratio is of numbers from the same minutes; a speed is the median of the repeats.
"""

import dataclasses
import importlib.util
import multiprocessing
import pathlib
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

import gasil_envs
from experiments.search import TASKS
from gasil_jax import presets
from gasil_jax.errors import InputError
from gasil_jax.host import command_line, metrics_files, output_file
from gasil_jax.host.environments import Settings, available_cores, prepare
from gasil_jax.host.members import make_members

VARIANTS = {
    "mjx": {"solver": "mjx"},
    "ours": {},
    "mujoco": {"physics": "mujoco"},
    "ours-euler": {"integrator": "euler"},
    "mujoco-euler": {"physics": "mujoco", "integrator": "euler"},
}
_HEAD = "envs     steps/s  ratio compile s  error of a step"


@dataclasses.dataclass(frozen=True)
class Options:
    """Measure speed and fidelity.

    Attributes:
      tables: of physics, training and scaling.
      envs: the tasks.
      variants: ways of building a task, in the physics table.
      num_envs: environments at once, in the physics table.
      num_steps: of random actions in a repeat.
      skip_errors: measure no error of a step, which takes a compilation more.
      repeats: how many times each row is timed.
      devices: CPU devices; default the cores.
      seeds: of training; in the scaling table a device's.
      training_envs: of a seed; default the preset's.
      training_variants: ways of building a task, in the training table.
      iterations: of training in a repeat.
      out: a new file; default runs/benchmark-TIME.json.
    """

    tables: tuple[str, ...] = ("physics", "training")
    envs: tuple[str, ...] = ("walker2d",)
    variants: tuple[str, ...] = tuple(VARIANTS)
    num_envs: tuple[int, ...] = (64,)
    num_steps: int = 20
    skip_errors: bool = False
    repeats: int = 5
    devices: int | None = None
    seeds: int = 10
    training_envs: int | None = None
    training_variants: tuple[str, ...] = ("ours", "mujoco")
    iterations: int = 2
    out: pathlib.Path | None = None


@dataclasses.dataclass
class Row:
    """One line of a table.

    Attributes:
      env: the task.
      name: what is measured.
      num_envs: environments that are stepped at once.
      run: does some steps and returns how many a second.
      compile_seconds: 0 where nothing is compiled.
      error: relative, of one step; None where it isn't measured.
      speeds: steps a second of each repeat.
    """

    env: str
    name: str
    num_envs: int
    run: Callable[[], float]
    compile_seconds: float = 0.0
    error: float | None = None
    speeds: list[float] = dataclasses.field(default_factory=list)


def _random_actions(env: Any, num_envs: int, key: jax.Array) -> jax.Array:
    low, high = env.action_range
    shape = (num_envs, env.action_size)
    return jax.random.uniform(key, shape, minval=low, maxval=high)


def make_rollout(env: Any, num_envs: int, num_steps: int) -> Any:
    """From states and a key to the states after random actions, and mean rewards."""

    def step(states: Any, key: jax.Array) -> Any:
        action_key, reset_key = jax.random.split(key)
        action = _random_actions(env, num_envs, action_key)
        stepped = jax.vmap(env.step)(states, action)
        fresh = jax.vmap(env.reset)(jax.random.split(reset_key, num_envs))

        def restart(first: jax.Array, now: jax.Array) -> jax.Array:
            done = (stepped.done > 0).reshape((-1,) + (1,) * (now.ndim - 1))
            return jnp.where(done, first, now).astype(now.dtype)

        return jax.tree.map(restart, fresh, stepped), stepped.reward.mean()

    def rollout(states: Any, key: jax.Array) -> Any:
        return jax.lax.scan(step, states, jax.random.split(key, num_steps))

    return rollout


def physics_row(env_name: str, name: str, num_envs: int, num_steps: int) -> Row:
    """Random actions in `num_envs` environments, shared out over the devices."""
    env = gasil_envs.make(env_name, **VARIANTS[name])
    count = max(n for n in range(1, len(jax.devices()) + 1) if num_envs % n == 0)
    mesh, spec = Mesh(np.array(jax.devices()[:count]), ("envs",)), P("envs")
    rollout = make_rollout(env, num_envs // count, num_steps)
    shard = lambda function, specs: jax.shard_map(
        function, mesh=mesh, in_specs=specs, out_specs=spec, check_vma=False
    )
    each = shard(lambda states, keys: rollout(states, keys[0])[0], (spec, spec))
    reset = jax.jit(shard(jax.vmap(env.reset), spec))
    states = reset(jax.random.split(jax.random.key(0), num_envs))
    keys = lambda number: jax.random.split(jax.random.key(number), count)
    began = time.perf_counter()
    compiled = jax.jit(each).lower(states, keys(0)).compile()
    compile_seconds = time.perf_counter() - began
    # Not from the start: most bodies have fallen to the ground after a while.
    states = jax.block_until_ready(compiled(states, keys(0)))

    def run() -> float:
        began = time.perf_counter()
        jax.block_until_ready(compiled(states, keys(1)))
        return num_envs * num_steps / (time.perf_counter() - began)

    return Row(env_name, name, num_envs, run, compile_seconds)


def one_step_error(env: Any, reference: Any, num_envs: int, num_steps: int) -> float:
    """Median relative error of the observation after one step from the same states."""
    keys = jax.random.split(jax.random.key(1), num_envs)
    states = jax.jit(jax.vmap(reference.reset))(keys)
    states, _ = jax.jit(make_rollout(reference, num_envs, num_steps))(states, keys[0])
    action = _random_actions(env, num_envs, keys[1])
    right = np.asarray(jax.jit(jax.vmap(reference.step))(states, action).obs)
    obs = np.asarray(jax.jit(jax.vmap(env.step))(states, action).obs)
    error = np.abs(obs - right) / (1.0 + np.abs(right))
    return float(np.median(error.max(axis=1)))


def physics_table(options: Options) -> Iterator[list[Row]]:
    """A list of rows for each task and number of environments."""
    for env_name in options.envs:
        reference = gasil_envs.make(env_name, physics="mujoco")
        errors: dict[str, float] = {}
        for num_envs in options.num_envs:
            rows = []
            for name in options.variants:
                row = physics_row(env_name, name, num_envs, options.num_steps)
                if name not in errors and not options.skip_errors:
                    env = gasil_envs.make(env_name, **VARIANTS[name])
                    errors[name] = one_step_error(env, reference, 64, options.num_steps)
                rows.append(dataclasses.replace(row, error=errors.get(name)))
            yield rows


def training_row(
    env_name: str,
    name: str,
    options: Options,
    seeds: int,
    devices: Sequence[jax.Device],
) -> Row:
    """PPO+GASIL with the paper's preset, `options.iterations` in a repeat."""
    env = gasil_envs.make(env_name, **VARIANTS[name])
    config = presets.preset(env_name, "ppo+gasil", "paper")
    config = config.replace(num_envs=options.training_envs or config.num_envs)
    # As many iterations in a call as the command line does at most.
    config = config.replace(total_steps=50 * options.iterations * config.batch_steps)
    members = make_members(env, config, range(seeds), devices=devices)
    began = time.perf_counter()
    states, advance = members.compile()
    compile_seconds = time.perf_counter() - began
    count = np.int32(options.iterations)
    held = [jax.block_until_ready(advance(states, count))[0]]

    def run() -> float:
        began = time.perf_counter()
        states, _ = jax.block_until_ready(advance(held.pop(), count))
        held.append(states)
        steps = options.iterations * config.batch_steps * seeds
        return steps / (time.perf_counter() - began)

    num_envs = seeds * config.num_envs
    return Row(env_name, f"ppo+gasil, {name}", num_envs, run, compile_seconds)


def _baseline(task: str, num_envs: int, steps: int, threads: int, pipe: Any) -> None:
    """Train Stable-Baselines3's PPO in a process of its own; send the seconds."""
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env

    # More threads than cores, and each waits for the others.
    torch.set_num_threads(threads)
    # 2048 steps, 10 epochs and minibatches of 64 are its own values, and ours.
    env = make_vec_env(task, num_envs)
    model = PPO("MlpPolicy", env, n_steps=2048 // num_envs, device="cpu")
    model.learn(2048)
    pipe.send("ready")
    pipe.recv()
    began = time.perf_counter()
    model.learn(steps)
    pipe.send(time.perf_counter() - began)


def baseline_row(env_name: str, processes: int, num_envs: int) -> Row:
    """Stable-Baselines3's PPO, as many runs at once as there are processes."""
    task, steps = gasil_envs.make(env_name).unwrapped.task.gymnasium_id, 3 * 2048
    context = multiprocessing.get_context("spawn")
    threads = max(1, available_cores() // processes)

    def run() -> float:
        pipes = []
        for _ in range(processes):
            mine, theirs = context.Pipe()
            arguments = (task, num_envs, steps, threads, theirs)
            context.Process(target=_baseline, args=arguments, daemon=True).start()
            # Else nobody would be told of the end of a process that failed.
            theirs.close()
            pipes.append(mine)
        for act in (lambda pipe: pipe.recv(), lambda pipe: pipe.send("go")):
            for pipe in pipes:
                act(pipe)
        return processes * steps / max(pipe.recv() for pipe in pipes)

    name = f"stable-baselines3 ppo, {processes} process{'es'[: 2 * (processes > 1)]}"
    return Row(env_name, name, processes * num_envs, run)


def training_table(options: Options) -> Iterator[list[Row]]:
    """A list of rows for each task."""
    for env_name in options.envs:
        config = presets.preset(env_name, "ppo+gasil", "paper")
        num_envs = options.seeds * (options.training_envs or config.num_envs)
        rows = []
        if importlib.util.find_spec("stable_baselines3"):
            for processes in sorted({1, available_cores()}):
                rows += [baseline_row(env_name, processes, n) for n in (1, 8)]
        for name in options.training_variants:
            row = physics_row(env_name, name, num_envs, options.num_steps)
            rows.append(dataclasses.replace(row, name=f"physics alone, {name}"))
            devices = jax.devices()
            rows.append(training_row(env_name, name, options, options.seeds, devices))
        yield rows


def scaling_table(options: Options) -> Iterator[list[Row]]:
    """A list of rows for each task: 1, 2, 4 ... devices, all of them at last."""
    devices = jax.devices()
    doubled = [2**power for power in range(len(devices)) if 2**power < len(devices)]
    for env_name in options.envs:
        rows = []
        for n in (*doubled, len(devices)):
            row = training_row(
                env_name, "ours", options, n * options.seeds, devices[:n]
            )
            name = f"{row.name}, {n} device{'s' * (n > 1)}"
            rows.append(dataclasses.replace(row, name=name))
        yield rows


def measure(rows: Sequence[Row], repeats: int) -> list[dict[str, Any]]:
    """Time the rows of a task in turn, print them, and return them."""
    for _ in range(repeats):
        for row in rows:
            row.speeds.append(row.run())
    described = []
    for row in rows:
        speed, first = (float(np.median(x.speeds)) for x in (row, rows[0]))
        error = "" if row.error is None else f"{row.error:11.1e}"
        print(
            f"{row.env:11} {row.name:36} {row.num_envs:6} {speed:11,.0f} "
            f"{speed / first:6.2f} {row.compile_seconds:9.1f}{error}",
            flush=True,
        )
        values = dataclasses.asdict(row) | {"speed": speed, "ratio": speed / first}
        del values["run"]
        described.append(values)
    return described


TABLES = {
    "physics": physics_table,
    "training": training_table,
    "scaling": scaling_table,
}


def _check(options: Options) -> None:
    for name, allowed in (
        ("tables", tuple(TABLES)),
        ("envs", TASKS),
        ("variants", tuple(VARIANTS)),
        ("training_variants", tuple(VARIANTS)),
    ):
        if others := set(getattr(options, name)) - set(allowed):
            raise InputError(
                f"{name} has {min(others)!r}: allowed {', '.join(allowed)}"
            )
    if (fewest := min(options.num_envs, default=0)) < 1:
        raise InputError(f"num_envs is {fewest}: it must be 1 or more")
    command_line.check_least(options, num_steps=1, repeats=1, seeds=1, iterations=1)
    command_line.check_least(options, devices=1, training_envs=1)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables and write them; returns the exit status."""
    return command_line.exit_status(lambda: _main(arguments))


def _main(arguments: Sequence[str] | None) -> None:
    options = command_line.parse(Options, arguments, "experiments benchmark")
    _check(options)
    stamp = time.strftime("%Y%m%d-%H%M%S")
    out = options.out or pathlib.Path("runs", f"benchmark-{stamp}.json")
    output_file.check(out, (".json",))
    output_file.make_parent(out)
    count = options.devices or available_cores()
    prepare(Settings(physics="mujoco"), count)
    jax.config.update("jax_num_cpu_devices", count)
    jax.config.update("jax_default_matmul_precision", "highest")
    devices = jax.devices()
    tables: dict[str, list[Any]] = {name: [] for name in options.tables}
    values = dataclasses.asdict(options).items()
    result = {
        "device": f"{len(devices)} x {devices[0].device_kind}",
        "cores": available_cores(),
        "options": {name: str(value) for name, value in values},
        "versions": metrics_files.versions(),
        "tables": tables,
    }
    print(f"{result['device']}, {result['cores']} cores")
    for table in options.tables:
        print(f"{table:51}{_HEAD}", flush=True)
        for rows in TABLES[table](options):
            tables[table] += measure(rows, options.repeats)
            # After every task: a benchmark that is cut off has its first figures.
            metrics_files.write_json(out, result)
    print(f"in {out}")
