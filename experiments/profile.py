"""Time of each part of a training iteration: ``python -m experiments profile``.

One iteration of the program that `gasil_jax.run` trains with is traced. XLA remembers
the functions that each of its operations was written in, which say what part it belongs
to. An operation's time is its median times its number, so that other processes hardly
matter. Tracing makes tiny operations look longer, those of physics above all.

All seeds are on one device. For the time of one core start it on one, ``taskset -c 0``.
"""

import collections
import dataclasses
import pathlib
import re
import tempfile
import time
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import jax
import numpy as np
import tyro

import gasil_envs
from gasil_envs.registry import Settings
from gasil_jax import presets
from gasil_jax.host import command_line, devices, metrics_files
from gasil_jax.host.members import make_members

#: Patterns of FILE.FUNCTION by part. An operation belongs to the first part of which a
#: function has called it, however indirectly.
PARTS: Mapping[str, str] = {
    "physics: solver": r"newton\.solve",
    "physics: constraint rows": r"constraints\.",
    "physics: collision": r"collision\.",
    "physics: smooth, integration": r"dynamics\.|tree\.|native\.",
    "environments: starts": r"\w+\.\w+\.reset",
    "environments: the rest": r"rollout\.collect\.<locals>\.step_one",
    "policy": r"train\.sample_trajectories\.<locals>",
    "rollout: the rest": r"train\.sample_trajectories",
    "history and buffer": r"train\.remember",
    "rewards": r"train\.learner_rewards",
    "discriminator": r"adversarial\.update_and_score",
    "advantages": r"train\.advantages",
    "PPO: permutations": r"permutation\.permutation",
    "PPO: minibatches": r"ppo\.update",
    "agent's other updates": r"train\.update_policy|\w+\._update_and_reward",
    "the rest": r"",
}
_CONTROL = ("while", "call", "conditional")


@dataclasses.dataclass(frozen=True)
class Options:
    """Measure the time of each part of a training iteration.

    Attributes:
      env: name of the environment.
      agent: name of the agent.
      preset: name of the preset.
      seeds: number of seeds.
      iterations: number of iterations before the one that is traced.
      repeats: number of times that a whole iteration is timed.
      settings: settings of the environment.
    """

    env: str = "walker2d"
    agent: str = "ppo+gasil"
    preset: str = "tuned"
    seeds: int = 5
    iterations: int = 10
    repeats: int = 5
    settings: Annotated[Settings, tyro.conf.arg(name="")] = dataclasses.field(
        default_factory=Settings
    )


def operations(program: str) -> dict[str, str]:
    """Return the part of each operation of a compiled program's text, by its name.

    One that XLA added itself belongs to what most of its neighbours belong to.
    """
    tables: dict[str, dict[str, str]] = collections.defaultdict(dict)
    blocks: list[dict[str, str | None]] = [{}]
    table = ""
    for line in program.splitlines():
        if re.fullmatch(r"FileNames|FunctionNames|FileLocations|StackFrames", line):
            table = line
        elif row := re.match(r"(\d+) (.*)", line):
            tables[table][row[1]] = row[2].strip('"')
        elif row := re.match(r"\s+(?:ROOT )?%?([\w.-]+) = .*?\s([\w-]+)\(", line):
            frame = re.search(r"stack_frame_id=(\d+)", line)
            if row[2] not in _CONTROL:
                blocks[-1][row[1]] = frame and frame[1]
        elif line.endswith("{"):
            blocks.append({})

    def number(name: str, text: str) -> str:
        (digits,) = re.findall(rf"{name}=(\d+)", text)
        return digits

    # XLA 0.10 counts parents from 1, so that the first frame seems to be its own.
    own = number("parent_frame_id", tables["StackFrames"].get("1", "parent_frame_id=0"))

    def functions(frame: str) -> list[str]:
        names = []
        while frame in tables["StackFrames"]:
            row = tables["StackFrames"][frame]
            location = tables["FileLocations"][number("file_location_id", row)]
            path = tables["FileNames"][number("file_name_id", location)]
            name = tables["FunctionNames"][number("function_name_id", location)]
            names.append(f"{pathlib.Path(path).stem}.{name}")
            frame = str(int(number("parent_frame_id", row)) - int(own))
        return names

    def part(names: Sequence[str]) -> str:
        matches = lambda pattern: any(re.match(pattern, name) for name in names)
        return next((p for p, pattern in PARTS.items() if matches(pattern)), "the rest")

    parts: dict[str, str] = {}
    for block in blocks:
        sure = {name: part(functions(frame)) for name, frame in block.items() if frame}
        usual = collections.Counter(sure.values()).most_common(1)
        parts |= {name: usual[0][0] if usual else "the rest" for name in block} | sure
    return parts


def trace(call: Any, program: str) -> dict[str, float]:
    """Return the seconds that each part of a program takes in a call of it."""
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            jax.block_until_ready(call())
        (path,) = pathlib.Path(folder).rglob("*.xplane.pb")
        profile = jax.profiler.ProfileData.from_file(str(path))
    times = collections.defaultdict(list)
    for plane in profile.planes:
        for line in plane.lines:
            for event in line.events:
                times[event.name].append(event.duration_ns)
    totals = dict.fromkeys(PARTS, 0.0)
    for name, part in operations(program).items():
        if name in times:
            totals[part] += float(np.median(times[name])) * len(times[name]) * 1e-9
    return totals


def run(options: Options) -> None:
    """Print the table."""
    command_line.check_least(options, seeds=1, iterations=1, repeats=1)
    devices.use_devices(options.settings, 1, options.seeds)
    # A cached program may have the functions of an earlier version.
    jax.config.update("jax_compilation_cache_include_metadata_in_key", True)
    with command_line.input_checked():
        delay = options.settings.reward_delay
        config = presets.preset(options.env, options.agent, options.preset, delay)
        env = gasil_envs.make(options.env, **dataclasses.asdict(options.settings))
        members = make_members(
            env, config, range(options.seeds), devices=jax.devices()[:1]
        )
    states, compiled = members.compile()
    advance: Any = compiled  # It has a text too.
    newest, seconds = [states], []

    def iterate() -> Any:
        states, metrics = advance(newest.pop(), np.int32(1))
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
        writer = metrics_files.MetricsWriter(path, labels, None)
        began = time.perf_counter()
        writer.write({name: np.asarray(x)[:, :1] for name, x in metrics.items()})
        totals["host: metrics.csv"] = time.perf_counter() - began
        writer.close()
    steps, total = options.seeds * config.batch_steps, sum(totals.values())
    rows = {**totals, "sum": total, "an iteration without trace": np.median(seconds)}
    print(f"{options.env}, {options.agent}, {options.seeds} seeds: us/env step  share")
    for part, of_part in rows.items():
        if of_part:
            print(f"{part:30} {of_part / steps * 1e6:9.2f} {of_part / total:9.3f}")
