"""Time of each part of a training iteration: ``python -m experiments profile``.

One iteration of the program that `gasil_jax.run` trains with is traced. XLA records the
named scopes of each operation, which say to which part it belongs. An operation's time
is its median duration times its number of executions, so other processes have little
effect. Tracing makes tiny operations look longer. On a CPU a step of physics is one
operation; on a GPU its parts are told apart.

All seeds are on one device. To measure one CPU core, start it with ``taskset -c 0``.
"""

import collections
import dataclasses
import pathlib
import re
import tempfile
import time
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

import gasil_envs
from experiments import measured
from gasil_envs.registry import Settings
from gasil_jax import checks, presets
from gasil_jax.cli.parsing import check_minimum, input_checked
from gasil_jax.host import devices, tables
from gasil_jax.host.members import make_members

#: Named scopes by part. An operation belongs to the first part whose scope it is in.
PARTS: Mapping[str, str] = {
    "physics: solver": "solver",
    "physics: constraint rows": "constraint_rows",
    "physics: collision": "collision",
    "physics: smooth dynamics": "smooth_dynamics",
    "physics": "physics",
    "environments: starts": "reset",
    "environments: the rest": "environment",
    "policy": "policy",
    "rollout: the rest": "rollout",
    "history and buffer": "good_trajectories",
    "rewards": "rewards",
    "discriminator": "discriminator",
    "advantages": "advantages",
    "PPO: permutations": "permutation",
    "PPO: minibatches": "ppo",
    "agent's other updates": "update_policy",
}
_REST = "the rest"
_CONTROL = ("while", "call", "conditional")
#: In the line of a call that is one kernel: on a CPU, a step of physics.
_KERNEL = "xla_cpu_small_call"


@dataclasses.dataclass(frozen=True)
class Options:
    """Measure the time of each part of a training iteration.

    Attributes:
      env: name of the environment.
      agent: name of the agent.
      preset: name of the preset.
      seeds: number of seeds.
      iterations: iterations before the one that is traced.
      repeats: times that a whole iteration is timed.
      page: write it into docs/performance.md too, below the same command.
    """

    env: str = "walker2d"
    agent: str = "ppo+gasil"
    preset: str = "tuned"
    seeds: int = 5
    iterations: int = 10
    repeats: int = 5
    page: bool = False


def operations(program: str) -> dict[str, str]:
    """Return the part of each operation in the text of a compiled program, by its name.

    An operation without scopes, which XLA added, belongs to the most frequent part of
    its block.
    """
    blocks: list[dict[str, str | None]] = [{}]
    for line in program.splitlines():
        if row := re.match(r"\s+(?:ROOT )?%?([\w.-]+) = .*?\s([\w-]+)\(", line):
            scopes = re.search(r'op_name="([^"]*)"', line)
            if row[2] not in _CONTROL or _KERNEL in line:
                blocks[-1][row[1]] = scopes and scopes[1]
        elif line.endswith("{"):
            blocks.append({})

    def part(scopes: str) -> str:
        names = set(re.findall(r"\w+", scopes))
        return next((x for x, scope in PARTS.items() if scope in names), _REST)

    parts: dict[str, str] = {}
    for block in blocks:
        sure = {name: part(scopes) for name, scopes in block.items() if scopes}
        usual = collections.Counter(sure.values()).most_common(1)
        parts |= {name: usual[0][0] if usual else _REST for name in block} | sure
    return parts


def seconds_of_parts(planes: Sequence[Any], program: str) -> dict[str, float]:
    """Return the seconds of each part of a compiled program, in a trace of it."""

    # A GPU kernel has the name of its operation, with _ instead of punctuation.
    def plain(name: str) -> str:
        return re.sub(r"\W", "_", name)

    on_gpu = [plane for plane in planes if plane.name.startswith("/device:GPU")]
    times = collections.defaultdict(list)
    for plane in on_gpu or planes:
        for line in plane.lines:
            for event in line.events:
                times[plain(event.name)].append(event.duration_ns)
    totals = dict.fromkeys((*PARTS, _REST), 0.0)
    for name, part in operations(program).items():
        if durations := times.pop(plain(name), None):
            totals[part] += float(np.median(durations)) * len(durations) * 1e-9
    if on_gpu:
        # Copies, and matrix products computed by a library.
        totals[_REST] += sum(map(sum, times.values())) * 1e-9
    return totals


def trace(call: Any, program: str) -> dict[str, float]:
    """Return the seconds that each part of a program takes in a call of it."""
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            jax.block_until_ready(call())
        (path,) = pathlib.Path(folder).rglob("*.xplane.pb")
        profile = jax.profiler.ProfileData.from_file(str(path))
    return seconds_of_parts(list(profile.planes), program)


def run(options: Options) -> None:
    """Print the table."""
    check_minimum(options, seeds=1, iterations=1, repeats=1)
    page = measured.find("profile", options) if options.page else None
    devices.use_devices(Settings(), 1, options.seeds)
    # Otherwise a cached program may have the scopes of an earlier version.
    jax.config.update("jax_compilation_cache_include_metadata_in_key", True)
    with input_checked():
        algorithm = presets.preset(options.env, options.agent, options.preset)
        env = gasil_envs.make(options.env)
        checks.check(env, algorithm)
    members = make_members(
        env, algorithm, range(options.seeds), devices=jax.devices()[:1]
    )
    states, compiled = members.compile()
    advance: Any = compiled  # Its declared type lacks `as_text`.
    newest, seconds = [states], []

    def iterate() -> Any:
        states, metrics = advance(newest.pop(), np.int32(1), members.data)
        newest.append(jax.block_until_ready(states))
        return metrics

    for _ in range(options.iterations):
        iterate()
    for _ in range(options.repeats):
        began = time.perf_counter()
        metrics = iterate()
        seconds.append(time.perf_counter() - began)
    totals = trace(iterate, advance.as_text())
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "metrics.csv"
        labels = {"seed": range(options.seeds)}
        writer = tables.TableWriter(path, labels)
        began = time.perf_counter()
        writer.write({name: np.asarray(x)[:, :1] for name, x in metrics.items()})
        totals["host: metrics.csv"] = time.perf_counter() - began
        writer.close()
    steps, total = options.seeds * algorithm.config.batch_steps, sum(totals.values())
    rows = {**totals, "sum": total, "an iteration without trace": np.median(seconds)}
    print(f"{options.env}, {options.agent}, {options.seeds} seeds: us/env step  share")
    shown = [
        (part, f"{of_part / steps * 1e6:.2f}", f"{of_part / total:.3f}")
        for part, of_part in rows.items()
        if of_part
    ]
    for part, time_of_step, share in shown:
        print(f"{part:30} {time_of_step:>9} {share:>9}")
    if page:
        head = [f"{options.env}, {options.agent}", "us a step", "share"]
        measured.write(page, head, shown)
