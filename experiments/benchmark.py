"""Speed and fidelity of physics and training: ``python -m experiments benchmark``.

- "physics": random actions with each way of building a task, and the relative error of
  one step against C MuJoCo with the model's own integrator, which is Gymnasium's. On a
  GPU also MuJoCo Warp through MJX, if it is installed (mujoco-mjx's extra "warp").
- "training": PPO+GASIL on many seeds at once, beside physics alone in as many
  environments and, if it is installed (the extra "benchmark"), Stable-Baselines3's PPO
  on Gymnasium's task: a run in one process, a run whose environments have processes of
  their own, and a run on every core.
- "scaling": training on 1, 2, 4 ... devices, with as many seeds on each device. A
  perfect ratio is the number of devices.

All rows of a task are compiled first. Then they are timed in turn, several times, so
that a ratio compares speeds from the same minutes. A speed is the median of the
repeats.
"""

import contextlib
import dataclasses
import functools
import importlib.util
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Literal

import jax
import numpy as np
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

import gasil_envs
from experiments import measured
from experiments.search import TASKS
from gasil_envs import wrappers
from gasil_jax import checks, presets
from gasil_jax.algorithms import Algorithm
from gasil_jax.cli.parsing import check_minimum, input_checked
from gasil_jax.errors import InputError, unknown
from gasil_jax.host import driver
from gasil_jax.host.environments import Settings, available_cores, prepare
from gasil_jax.host.members import make_members

Table = Literal["physics", "training", "scaling"]
Variant = Literal["mjx", "ours", "mujoco", "ours-euler", "mujoco-euler"]
VARIANTS: Mapping[str, Mapping[str, str]] = {
    "mjx": {"physics": "mjx"},
    "ours": {},
    "mujoco": {"physics": "mujoco"},
    "ours-euler": {"integrator": "euler"},
    "mujoco-euler": {"physics": "mujoco", "integrator": "euler"},
}
_NUM_STEPS, _BASELINE_STEPS = 20, 3 * 2048
# XLA's flags before `start_jax` adds to them.
_FLAGS = os.environ.get("XLA_FLAGS", "")


@dataclasses.dataclass(frozen=True)
class Options:
    """Measure the speed and fidelity of physics and training.

    Attributes:
      tables: tables to print.
      envs: locomotion tasks.
      variants: ways of building a task, instead of the table's.
      num_envs: numbers of environments in the physics table.
      repeats: times that each row is timed.
      devices: CPU devices, instead of one per core.
      seeds: seeds to train; in the scaling table on each device.
      training_envs: environments per seed, instead of the preset's.
      iterations: iterations in a repeat.
      page: write it into docs/performance.md too, below the same command.
    """

    tables: tuple[Table, ...] = ("physics", "training")
    envs: tuple[str, ...] = ("walker2d",)
    variants: tuple[Variant, ...] = ()
    num_envs: tuple[int, ...] = (64,)
    repeats: int = 5
    devices: int | None = None
    seeds: int = 10
    training_envs: int | None = None
    iterations: int = 2
    page: bool = False


@dataclasses.dataclass
class Row:
    """One line of a table."""

    env: str
    name: str
    num_envs: int
    run: Callable[[], float]
    compile_seconds: float = 0.0
    error: float | None = None
    speed: float = 0.0


def start_jax(num_devices: int, physics: str = "mujoco") -> None:
    """Choose CPU devices and precision as commands do; call it before JAX starts."""
    prepare(Settings(physics=physics), num_devices)
    jax.config.update("jax_num_cpu_devices", num_devices)
    jax.config.update("jax_default_matmul_precision", "highest")


def make(env_name: str, variant: str) -> Any:
    """Return a task whose ended episodes begin anew, built in one of the ways."""
    return wrappers.AutoReset(gasil_envs.make(env_name, **VARIANTS[variant]))


def random_step(env: Any, states: Any, key: jax.Array) -> Any:
    """Return the states of environments after a random action."""
    low, high = env.action_range
    shape = (states.done.shape[0], env.action_size)
    action = jax.random.uniform(key, shape, minval=low, maxval=high)
    return jax.vmap(env.step)(states, action)


def _random_steps(env: Any, states: Any, key: jax.Array) -> Any:
    keys = jax.random.split(key, _NUM_STEPS)
    return jax.lax.scan(lambda x, k: (random_step(env, x, k), None), states, keys)[0]


def _keys(number: int, count: int) -> jax.Array:
    return jax.random.split(jax.random.key(number), count)


def speed_of(call: Callable[[], Any], steps: int) -> float:
    """Return the steps per second of a call that takes so many steps."""
    began = time.perf_counter()
    jax.block_until_ready(call())
    return steps / (time.perf_counter() - began)


def _serve(pipe: Any, flags: str, num_devices: int, build: Callable[[], Row]) -> None:
    """Time a row of MJX in this process whenever the pipe asks for it."""
    os.environ["XLA_FLAGS"] = flags
    start_jax(num_devices, "mjx")
    row = build()
    # A compiled program cannot be sent.
    pipe.send(dataclasses.replace(row, run=float))
    with contextlib.suppress(EOFError):
        while pipe.recv():
            pipe.send(row.run())


def _row(variant: str, build: Callable[[], Row]) -> Row:
    """Build a row; on a CPU that of MJX in a process of its own."""
    # The option that keeps the loops of our physics is of a whole process, and slows
    # MJX.
    if variant != "mjx" or jax.default_backend() != "cpu":
        return build()
    context = multiprocessing.get_context("spawn")
    pipe, theirs = context.Pipe()
    arguments = (theirs, _FLAGS, len(jax.devices()), build)
    context.Process(target=_serve, args=arguments, daemon=True).start()
    theirs.close()

    def run() -> float:
        pipe.send("go")
        return float(pipe.recv())

    return dataclasses.replace(pipe.recv(), run=run)


def _rollout_row(
    env: str, name: str, num_envs: int, rollout: Any, *, states: Any, keys: int
) -> Row:
    """Return a row of a compiled rollout, (states, keys) -> states."""
    began = time.perf_counter()
    advance = rollout.lower(states, _keys(0, keys)).compile()
    # Timed after some steps, when most bodies lie on the ground, as they do later. Warp
    # compiles its kernels at the first call.
    states = jax.block_until_ready(advance(states, _keys(0, keys)))
    seconds, again = time.perf_counter() - began, _keys(1, keys)
    steps = num_envs * _NUM_STEPS
    run = functools.partial(speed_of, lambda: advance(states, again), steps)
    return Row(env, name, num_envs, run, seconds)


def physics_row(env_name: str, variant: str, num_envs: int) -> Row:
    """Random actions in environments that are spread over the devices."""
    env = make(env_name, variant)
    count = max(n for n in range(1, len(jax.devices()) + 1) if num_envs % n == 0)
    mesh = Mesh(np.array(jax.devices()[:count]), ("envs",))
    shard = functools.partial(
        jax.shard_map,
        mesh=mesh,
        in_specs=P("envs"),
        out_specs=P("envs"),
        check_vma=False,
    )
    states = jax.jit(shard(jax.vmap(env.reset)))(_keys(0, num_envs))
    rollout = jax.jit(shard(lambda states, keys: _random_steps(env, states, keys[0])))
    return _rollout_row(env_name, variant, num_envs, rollout, states=states, keys=count)


def warp_row(env_name: str, num_envs: int) -> Row:
    """Random actions in MuJoCo Warp, without rewards, observations and resets."""
    from mujoco import mjx

    env = gasil_envs.make(env_name, **VARIANTS["mjx"]).unwrapped
    frame_skip, (low, high) = env.task.frame_skip, env.action_range
    model = mjx.put_model(env.model, impl="warp")
    # Warp warns that four iterations of the solver, which all rows have, are few.
    model = model.tree_replace({"opt._impl.warn_overflow": 0})
    blank = mjx.make_data(env.model, impl="warp", naconmax=24 * num_envs, njmax=128)
    step = jax.vmap(mjx.step, in_axes=(None, 0))

    def random_step(data: Any, key: jax.Array) -> tuple[Any, None]:
        shape = (num_envs, env.action_size)
        action = jax.random.uniform(key, shape, minval=low, maxval=high)
        data = data.replace(ctrl=action)
        return jax.lax.fori_loop(0, frame_skip, lambda _, x: step(model, x), data), None

    def start(key: jax.Array) -> Any:
        physics = env.reset(key).pipeline_state.physics
        return blank.replace(qpos=physics.qpos, qvel=physics.qvel)

    rollout = jax.jit(lambda data, keys: jax.lax.scan(random_step, data, keys)[0])
    states = jax.vmap(start)(_keys(0, num_envs))
    return _rollout_row(
        env_name, "warp", num_envs, rollout, states=states, keys=_NUM_STEPS
    )


def one_step_error(env_name: str, variant: str) -> float:
    """Return the median, over states, of a step's worst error relative to C MuJoCo."""
    env, reference = make(env_name, variant), make(env_name, "mujoco")
    keys = jax.random.split(jax.random.key(1), 64)
    states = jax.jit(jax.vmap(reference.reset))(keys)
    states = jax.jit(functools.partial(_random_steps, reference))(states, keys[0])
    obs, right = (
        np.asarray(jax.jit(functools.partial(random_step, x))(states, keys[1]).obs)
        for x in (env, reference)
    )
    error = np.abs(obs - right) / (1.0 + np.abs(right))
    return float(np.median(error.max(axis=1)))


def physics_table(env_name: str, options: Options) -> Iterator[list[Row]]:
    """The rows of each number of environments."""
    variants = options.variants or VARIANTS
    errors = {name: one_step_error(env_name, name) for name in variants}
    for num_envs in options.num_envs:
        rows = [
            _row(name, functools.partial(physics_row, env_name, name, num_envs))
            for name in errors
        ]
        rows = [dataclasses.replace(row, error=errors[row.name]) for row in rows]
        if importlib.util.find_spec("warp") and jax.default_backend() == "gpu":
            rows.append(warp_row(env_name, num_envs))
        yield rows


def _algorithm(env_name: str, options: Options) -> Algorithm:
    algorithm = presets.preset(env_name, "ppo+gasil", "paper")
    num_envs = options.training_envs or algorithm.config.num_envs
    # As many iterations in a call as the command line does at most.
    total_steps = 50 * options.iterations * algorithm.config.batch_steps
    return algorithm.replace(num_envs=num_envs, total_steps=total_steps)


def training_row(
    env_name: str, variant: str, options: Options, *, devices: int, seeds: int
) -> Row:
    """PPO+GASIL with the paper's preset."""
    env = gasil_envs.make(env_name, **VARIANTS[variant])
    algorithm, used = _algorithm(env_name, options), jax.devices()[:devices]
    num_envs, batch_steps = algorithm.config.num_envs, algorithm.config.batch_steps
    with input_checked():
        checks.check(env, algorithm)
    batch = make_members(env, algorithm, range(seeds), devices=used)
    began = time.perf_counter()
    states, advance = batch.compile()
    compile_seconds = time.perf_counter() - began
    count = np.int32(options.iterations)
    newest = [jax.block_until_ready(advance(states, count, batch.data))[0]]

    def train() -> Any:
        newest.append(advance(newest.pop(), count, batch.data)[0])
        return newest

    run = functools.partial(speed_of, train, options.iterations * batch_steps * seeds)
    name = f"ppo+gasil, {variant}"
    return Row(env_name, name, seeds * num_envs, run, compile_seconds)


def _train_baseline(
    task: str, num_envs: int, spread: bool, *, threads: int, pipe: Any
) -> None:
    """Train Stable-Baselines3's PPO in a separate process, when the pipe says "go"."""
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

    # With more threads than cores, threads wait for each other.
    torch.set_num_threads(threads)
    # 2048 steps, 10 epochs and minibatches of 64 are the defaults there and here.
    kind = SubprocVecEnv if spread else DummyVecEnv
    env = make_vec_env(task, num_envs, vec_env_cls=kind)
    model = PPO("MlpPolicy", env, n_steps=2048 // num_envs, device="cpu")
    model.learn(2048)
    pipe.send("ready")
    pipe.recv()
    began = time.perf_counter()
    model.learn(_BASELINE_STEPS)
    pipe.send(time.perf_counter() - began)
    env.close()


def baseline_row(
    env_name: str, runs: int, num_envs: int, *, spread: bool = False
) -> Row:
    """Stable-Baselines3's PPO, a process for each run or, spread, for each env."""
    task = gasil_envs.make(env_name).unwrapped.task.gymnasium_id
    context = multiprocessing.get_context("spawn")
    threads = max(1, available_cores() // runs)

    def run() -> float:
        pipes, processes = [], []
        for _ in range(runs):
            mine, theirs = context.Pipe()
            process = context.Process(
                target=_train_baseline,
                args=(task, num_envs, spread),
                kwargs={"threads": threads, "pipe": theirs},
                daemon=not spread,  # A daemon may not start processes.
            )
            process.start()
            processes.append(process)
            # While this end is open, a failed process would leave `recv` waiting.
            theirs.close()
            pipes.append(mine)
        for pipe in pipes:
            pipe.recv()
        for pipe in pipes:
            pipe.send("go")
        seconds = max(pipe.recv() for pipe in pipes)
        # The next row must not be timed while they still run.
        for process in processes:
            process.join()
        return runs * _BASELINE_STEPS / seconds

    count = runs * num_envs if spread else runs
    name = f"stable-baselines3 ppo, {count} process{'es'[: 2 * (count > 1)]}"
    return Row(env_name, name, runs * num_envs, run)


def training_table(env_name: str, options: Options) -> Iterator[list[Row]]:
    """Training beside physics alone and Stable-Baselines3."""
    num_envs = options.seeds * _algorithm(env_name, options).config.num_envs
    rows, sizes = [], {"devices": len(jax.devices()), "seeds": options.seeds}
    if importlib.util.find_spec("stable_baselines3"):
        for runs in sorted({1, available_cores()}):
            rows += [baseline_row(env_name, runs, n) for n in (1, 8)]
        rows.append(baseline_row(env_name, 1, 8, spread=True))
    for variant in options.variants or ("ours", "mujoco"):
        physics = functools.partial(physics_row, env_name, variant, num_envs)
        row = _row(variant, physics)
        rows.append(dataclasses.replace(row, name=f"physics alone, {variant}"))
        train = functools.partial(training_row, env_name, variant, options, **sizes)
        rows.append(_row(variant, train))
    yield rows


def scaling_table(env_name: str, options: Options) -> Iterator[list[Row]]:
    """Training on 1, 2, 4 ... devices, and finally on all of them."""
    most, rows = len(jax.devices()), []
    for n in (*(2**i for i in range(most) if 2**i < most), most):
        row = training_row(
            env_name, "ours", options, devices=n, seeds=n * options.seeds
        )
        name = f"{row.name}, {n} device{'s' * (n > 1)}"
        rows.append(dataclasses.replace(row, name=name))
    yield rows


def measure(rows: Sequence[Row], repeats: int) -> None:
    """Time the rows of a task in turn and print them."""
    speeds = np.median([[row.run() for row in rows] for _ in range(repeats)], axis=0)
    for row, speed in zip(rows, speeds, strict=True):
        row.speed = speed
        error = "" if row.error is None else f"{row.error:17.1e}"
        print(
            f"{row.env:16} {row.name:36} {row.num_envs:6} {speed:11,.0f} "
            f"{speed / speeds[0]:6.2f} {row.compile_seconds:9.1f}{error}",
            flush=True,
        )


def for_page(rows: Sequence[Row]) -> tuple[list[str], list[list[str]]]:
    """Return the head and the lines of a table: a line per task, or per row of one."""
    tasks: dict[str, list[Row]] = {}
    for row in rows:
        tasks.setdefault(row.env, []).append(row)
    if len(tasks) == 1:
        head = [rows[0].env, "environments", "steps/s", "compile s"]
        return head, [
            [x.name, f"{x.num_envs:,}", f"{x.speed:,.0f}", f"{x.compile_seconds:.0f}"]
            for x in rows
        ]
    first, *_ = tasks.values()
    several = len({x.name for x in first}) < len(first)
    names = [f"{x.num_envs:,}: {x.name}" if several else x.name for x in first]
    has_errors = first[0].error is not None
    head = ["steps/s", *names, "compile s", *["errors of a step"] * has_errors]
    lines = []
    for env, each in tasks.items():
        speeds = [f"{x.speed:,.0f}" for x in each]
        seconds = ", ".join(f"{x.compile_seconds:.0f}" for x in each)
        lines.append([env, *speeds, seconds])
        if has_errors:
            errors = [f"{x.error:.0e}" for x in each if x.error is not None]
            lines[-1].append(", ".join(errors))
    return head, lines


TABLES: Mapping[str, Callable[[str, Options], Iterator[list[Row]]]] = {
    "physics": physics_table,
    "training": training_table,
    "scaling": scaling_table,
}


def run(options: Options) -> None:
    """Print the tables."""
    whole = ("repeats", "devices", "seeds", "training_envs", "iterations")
    check_minimum(options, **dict.fromkeys(whole, 1))
    for env in options.envs:
        if env not in TASKS:
            raise InputError(unknown("envs", env, TASKS))
    page = measured.find("benchmark", options) if options.page else None
    start_jax(options.devices or available_cores())
    print(measured.machine())
    versions = driver.versions()
    print(", ".join(f"{name} {x}" for name, x in versions.items() if x is not None))
    every: list[Row] = []
    for table in options.tables:
        print(f"{table:54}  envs     steps/s  ratio compile s  error of a step")
        for env_name in options.envs:
            for rows in TABLES[table](env_name, options):
                measure(rows, options.repeats)
                every += rows
    if page:
        measured.write(page, *for_page(every))
