"""Check before compiling that programs fit the devices' memory."""

import contextlib
import math
import pathlib
from collections.abc import Iterator, Sequence
from typing import Any

import jax
from jax.extend import core

from gasil_envs import wrappers
from gasil_jax import train
from gasil_jax.algorithms import Algorithm
from gasil_jax.errors import InputError
from gasil_jax.host.programs import Program
from gasil_jax.host.sweep import Recording

# Memory of a program besides its states, in batches. XLA reports 7 to 11 for eight
# programs with different agents and shapes (tests/host/test_resources.py).
_BATCHES_PER_PROGRAM = 8
# Memory of an evaluated episode, in states of its environment. XLA reports 7 (point
# mass) and 25 (hopper).
_STATES_PER_EPISODE = 7


def check(
    env: Any,
    programs: Sequence[Program],
    recording: Recording,
    devices: Sequence[jax.Device],
) -> None:
    """Raise `InputError`, with the sizes, if programs do not fit the memory."""
    for each in programs:
        count, algorithm = len(each.runs), each.algorithm
        check_memory(need(env, algorithm), algorithm, count, devices)
        if recording.evaluate_every is not None:
            episodes = recording.evaluate_episodes
            option = "evaluate_episodes"
            check_episodes(env, episodes, count, devices, option=option)


def _size(tree: Any) -> int:
    def bytes_of(leaf: Any) -> int:
        # A key consists of two 32-bit words.
        is_key = jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return math.prod(leaf.shape) * (8 if is_key else leaf.dtype.itemsize)

    return sum(map(bytes_of, jax.tree.leaves(tree)))


def need(env: Any, algorithm: Algorithm) -> int:
    """Estimate the bytes of memory that one run needs, within a factor of two."""
    state = jax.eval_shape(lambda: train.first_state(env, algorithm, jax.random.key(0)))
    # Numbers per step: the fields of a `Rollout` and those that PPO adds.
    numbers = 2 * env.observation_size + wrappers.action_size(env) + 12
    batches = _BATCHES_PER_PROGRAM * 4 * algorithm.config.batch_steps * numbers
    # What is learned may be large, and is copied if it is not donated.
    return _size(state) + _size(state.agent) + _size(state.actor_critic) + batches


def available(devices: Sequence[jax.Device]) -> int | None:
    """Return the free bytes of the devices, in equal shares; None if unknown."""
    if devices[0].platform != "cpu":
        every = [device.memory_stats() or {} for device in devices]
        if any("bytes_limit" not in stats for stats in every):
            return None
        free = [x["bytes_limit"] - x.get("bytes_in_use", 0) for x in every]
        return len(devices) * min(free)
    free = _free_in_control_groups()
    # Only Linux has this file and this line.
    with contextlib.suppress(OSError, LookupError):
        text = pathlib.Path("/proc/meminfo").read_text()
        free.append(1024 * int(text.split("MemAvailable:")[1].split()[0]))
    return min(free, default=None)


def _free_in_control_groups(
    root: pathlib.Path = pathlib.Path("/sys/fs/cgroup"),
    own: pathlib.Path = pathlib.Path("/proc/self/cgroup"),
) -> list[int]:
    """Return what is left below each limit of this process's control groups."""
    free: list[int] = []
    # Only Linux has control groups, and a group may have no limit.
    with contextlib.suppress(OSError, LookupError):
        group = root / own.read_text().strip().split(":", 2)[2].lstrip("/")
        for folder in (group, *group.parents):
            with contextlib.suppress(OSError, ValueError, LookupError):
                limit = int((folder / "memory.max").read_text())
                used = int((folder / "memory.current").read_text())
                lines = (folder / "memory.stat").read_text().splitlines()
                cached = int(dict(map(str.split, lines))["inactive_file"])
                free.append(limit - used + cached)
            if folder == root:
                break
    return free


def _padded(count: int, devices: Sequence[jax.Device]) -> int:
    """Return the number of members, rounded up to a multiple of the devices' number."""
    return math.ceil(count / len(devices)) * len(devices)


def check_memory(
    one: int, algorithm: Algorithm, num_members: int, devices: Sequence[jax.Device]
) -> None:
    """Raise `InputError` if members of `one` bytes do not fit into memory at once."""
    used, config = devices[:num_members], algorithm.config
    required = _padded(num_members, used) * one
    if (free := available(used)) is not None and required > free:
        # Each device trains the same number of members.
        fit = max(0, free // len(used)) // one * len(used)
        raise InputError(
            f"seeds are {num_members} (over all points): they need about "
            f"{_in_words(required)} of memory, {_in_words(one)} each with num_envs "
            f"{config.num_envs} and batch_steps {config.batch_steps}, and "
            f"{_in_words(free)} are free: at most {fit} fit"
        )


def check_arrays(
    traced: core.Jaxpr, algorithm: Algorithm, devices: Sequence[jax.Device]
) -> None:
    """Raise `InputError` if a single array of a traced program does not fit memory.

    So a count that shapes an array is refused whatever it is, also a user's own. The
    program is one function that each of the devices runs.
    """
    inner = (x for part in core.subjaxprs(traced) for x in _arrays(part))
    largest, free = max(inner, key=_size, default=None), available(devices)
    if largest is None or free is None or len(devices) * _size(largest) <= free:
        return
    counts = [
        f"{name} {value}"
        for name, value in algorithm.settings.items()
        if type(value) is int and value > 1 and value in largest.shape
    ]
    shaped = f", with {' and '.join(counts)}" if counts else ""
    raise InputError(
        f"training has an array of shape {largest.shape}{shaped}: it needs "
        f"{_in_words(len(devices) * _size(largest))} of memory, and {_in_words(free)} "
        "are free"
    )


def _arrays(program: core.Jaxpr) -> Iterator[Any]:
    """Yield the shape and dtype of each array that a program makes."""
    for equation in program.eqns:
        yield from (x.aval for x in equation.outvars if hasattr(x.aval, "dtype"))
    for part in core.subjaxprs(program):
        yield from _arrays(part)


def check_episodes(
    env: Any,
    num_episodes: int,
    num_policies: int,
    devices: Sequence[jax.Device],
    *,
    option: str = "episodes",
) -> None:
    """Raise `InputError` if an evaluation's episodes do not fit the devices' memory."""
    state = _size(jax.eval_shape(env.reset, jax.random.key(0)))
    used = devices[:num_policies]
    each, free = _STATES_PER_EPISODE * state * num_episodes, available(used)
    required = _padded(num_policies, used) * each
    if free is not None and required > free:
        raise InputError(
            f"{option} is {num_episodes}: the episodes of {num_policies} policies at "
            f"once need at least {_in_words(required)} of memory, and "
            f"{_in_words(free)} are free"
        )


def _in_words(number: int) -> str:
    return f"{number / 1e9:.2f} GB" if number >= 1e7 else f"{number / 1e6:.2f} MB"
