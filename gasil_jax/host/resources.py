"""Whether a batch of runs fits the device and the disk, before anything compiles."""

import math
import pathlib
import shutil
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax

from gasil_jax import train
from gasil_jax.config import Config

# Measured with XLA's own account of eight programs, agents and shapes that differ: the
# program needs 7 to 11 times a batch beside the states (tests/test_resources.py).
_BATCHES = 8
# By the same account an episode that is scored needs 7 (point mass) or 25 (hopper)
# times its environment's state.
_STATES = 7


class Need(NamedTuple):
    """Bytes of one run.

    Attributes:
      state: of its `TrainState`, which is what a checkpoint holds.
      memory: while it trains.
    """

    state: int
    memory: int


def _size(tree: Any) -> int:
    def bytes_of(leaf: Any) -> int:
        # A key is two words.
        is_key = jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return math.prod(leaf.shape) * (8 if is_key else leaf.dtype.itemsize)

    return sum(map(bytes_of, jax.tree.leaves(tree)))


def need(env: Any, config: Config) -> Need:
    """What one run takes; memory is an estimate, within a factor of two."""
    state = jax.eval_shape(lambda: train.init(env, config, jax.random.key(0)))
    # The fields of a `Rollout`, and as much again for what PPO adds to it.
    numbers = 2 * env.observation_size + env.action_size + 12
    batch = 4 * config.batch_steps * numbers
    # What imitates may be large, and is copied when it is not donated.
    memory = _size(state) + _size(state.imitation) + _BATCHES * batch
    return Need(_size(state), memory)


def available(devices: Sequence[jax.Device]) -> int | None:
    """Bytes that are free for the programs of these devices, None if unknown."""
    if devices[0].platform != "cpu":
        stats = devices[0].memory_stats() or {}
        if "bytes_limit" not in stats:
            return None
        return len(devices) * (stats["bytes_limit"] - stats.get("bytes_in_use", 0))
    free = []
    for path, read in (
        ("/proc/meminfo", lambda text: int(text.split("MemAvailable:")[1].split()[0])),
        ("/sys/fs/cgroup/memory.max", lambda text: int(text) // 1024),
    ):
        try:
            free.append(1024 * read(pathlib.Path(path).read_text()))
        except (OSError, ValueError, IndexError):
            continue
    return min(free, default=None)


def check_memory(
    env: Any, config: Config, num_members: int, devices: Sequence[jax.Device]
) -> None:
    """Refuse what does not fit the devices.

    Args:
      env: one environment.
      config: of the runs.
      num_members: trained at once.
      devices: that they are sharded over.

    Raises:
      ValueError: the numbers.
    """
    one = need(env, config)
    wanted, free = num_members * one.memory, available(devices)
    if free is not None and wanted > free:
        raise ValueError(
            f"seeds are {num_members} (over all points): they need about "
            f"{_in_words(wanted)} of memory, {_in_words(one.memory)} each with "
            f"num_envs {config.num_envs} and batch_steps {config.batch_steps}, and "
            f"{_in_words(free)} are free: at most {free // one.memory} fit"
        )


def check_episodes(
    env: Any,
    num_episodes: int,
    num_policies: int,
    devices: Sequence[jax.Device],
    *,
    option: str = "episodes",
) -> None:
    """Refuse more episodes side by side than fit the devices.

    Args:
      env: one environment.
      num_episodes: of each policy.
      num_policies: scored at once.
      devices: that they run on.
      option: that gives their number.

    Raises:
      ValueError: the numbers.
    """
    state = _size(jax.eval_shape(env.reset, jax.random.key(0)))
    wanted, free = _STATES * state * num_episodes * num_policies, available(devices)
    if free is not None and wanted > free:
        raise ValueError(
            f"{option} is {num_episodes}: of {num_policies} policies side by side they "
            f"need at least {_in_words(wanted)} of memory, and {_in_words(free)} are "
            "free"
        )


def check_disk(
    env: Any,
    runs: Sequence[tuple[Config, int]],
    folder: pathlib.Path,
    num_checkpoints: int,
) -> None:
    """Refuse what does not fit the disk.

    Args:
      env: one environment.
      runs: each configuration, and how many members have it.
      folder: that checkpoints are written to; need not exist.
      num_checkpoints: of each that are kept.

    Raises:
      ValueError: the numbers.
    """
    while not folder.exists():
        folder = folder.parent
    sizes = [need(env, config).state * num_members for config, num_members in runs]
    # One more of those that train is being written.
    wanted = num_checkpoints * sum(sizes) + max(sizes, default=0)
    free = _free_disk(folder)
    if free is not None and wanted > free:
        members = sum(num_members for _, num_members in runs)
        raise ValueError(
            f"out is in {folder.absolute()}, where {_in_words(free)} are free: "
            f"{num_checkpoints} checkpoints of {members} seeds (over all points), and "
            f"one that is being written, need {_in_words(wanted)}"
        )


def _free_disk(folder: pathlib.Path) -> int | None:
    usage = shutil.disk_usage(folder)
    # A file system that is none, such as /proc, has no size.
    return usage.free if usage.total else None


def _in_words(number: int) -> str:
    return f"{number / 1e9:.2f} GB" if number >= 1e7 else f"{number / 1e6:.2f} MB"
