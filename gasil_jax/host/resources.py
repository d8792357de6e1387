"""Check before compiling that a batch of runs fits the devices and the disk."""

import contextlib
import math
import pathlib
import shutil
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax

from gasil_envs import wrappers
from gasil_jax import train
from gasil_jax.algorithms import Algorithm
from gasil_jax.config import Config

# Memory of a program besides its states, in batches. XLA reports 7 to 11 for eight
# programs with different agents and shapes (tests/host/test_resources.py).
_BATCHES_PER_PROGRAM = 8
# Memory of a gradient step, or of a network's pass over a batch, in outputs of its
# layers. XLA reports 1.9 to 3.1, and twice that with a penalty on the gradient.
_OUTPUTS_PER_STEP = 2.5
# Memory of an evaluated episode, in states of its environment. XLA reports 7 (point
# mass) and 25 (hopper).
_STATES_PER_EPISODE = 7
# The folder of all control groups, and the file that lists those of this process.
_CONTROL_GROUPS = pathlib.Path("/sys/fs/cgroup")
_OWN_CONTROL_GROUPS = pathlib.Path("/proc/self/cgroup")


class Need(NamedTuple):
    """The bytes that one run needs.

    Attributes:
      state: size of its `TrainState`, which is the size of a checkpoint.
      memory: memory during training.
      largest_part: what most of the memory is for, in words.
      shared: memory of what all runs on a device share, the agent's data.
    """

    state: int
    memory: int
    largest_part: str
    shared: int = 0


def _size(tree: Any) -> int:
    def bytes_of(leaf: Any) -> int:
        # A key consists of two 32-bit words.
        is_key = jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return math.prod(leaf.shape) * (8 if is_key else leaf.dtype.itemsize)

    return sum(map(bytes_of, jax.tree.leaves(tree)))


def need(env: Any, algorithm: Algorithm) -> Need:
    """Estimate the bytes that one run needs; memory is within a factor of two."""
    state = jax.eval_shape(lambda: train.init(env, algorithm, jax.random.key(0)))
    config = algorithm.config
    # Numbers per step: the fields of a `Rollout` and those that PPO adds.
    numbers = 2 * env.observation_size + wrappers.action_size(env) + 12
    batches = _BATCHES_PER_PROGRAM * 4 * config.batch_steps * numbers
    steps = _gradient_steps(env, algorithm)
    # What is learned may be large, and is copied if it is not donated. Gradient steps
    # come after the batch's other uses, and one after the other.
    learned = _size(state.agent) + _size(state.actor_critic)
    memory = _size(state) + learned + max(batches, *steps.values())
    data = _size(jax.eval_shape(algorithm.agent.data))
    episodes = (state.environments, state.history, state.rewards)
    parts = {
        f"batches, with batch_steps {config.batch_steps}": batches,
        f"running episodes, with num_envs {config.num_envs}": _size(episodes),
        f"the state of agent {algorithm.agent.name!r}{_of_buffer(algorithm)}": (
            2 * _size(state.agent)
        ),
        f"the data of agent {algorithm.agent.name!r}": data,
        "networks": 2 * _size(state.actor_critic),
        **steps,
    }
    largest = max(parts, key=lambda part: parts[part])
    return Need(_size(state), memory, largest, data)


def _gradient_steps(env: Any, algorithm: Algorithm) -> dict[str, int]:
    """Return the bytes of each kind of gradient step, by the sizes in words.

    These are the drawn steps and the outputs of a network's layers, also in a pass over
    the whole batch.
    """
    settings, steps = algorithm.settings, {}
    inputs = env.observation_size + wrappers.action_size(env)
    for name, minibatch_size in settings.items():
        # An agent of the user's may have one that is None.
        if name.endswith("minibatch_size") and minibatch_size:
            widths = name.replace("minibatch_size", "hidden_sizes")
            widths = widths if widths in settings else "hidden_sizes"
            sizes = {name: minibatch_size, "batch_steps": settings["batch_steps"]}
            largest = max(sizes, key=lambda size: sizes[size])
            rows = sizes[largest]
            outputs = _OUTPUTS_PER_STEP * 4 * rows * (inputs + sum(settings[widths]))
            words = f"{largest} {rows} and {widths} {settings[widths]}"
            steps[f"outputs of layers, with {words}"] = int(outputs)
    return steps


def _of_buffer(algorithm: Algorithm) -> str:
    """Return the size of the agent's buffer in words, if it has one."""
    names = ("buffer_steps", "sil_buffer_steps")
    sizes = {x: y for x, y in algorithm.settings.items() if x in names}
    return "".join(f", with {name} {size}" for name, size in sizes.items())


def available(devices: Sequence[jax.Device]) -> int | None:
    """Return the free bytes of the devices together; None if unknown.

    All devices get equal shares, so the one with the least free memory counts.
    """
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


class _Files(NamedTuple):
    """The files of a control group's limit and use, and the field of its cache."""

    limit: str
    used: str
    cached: str


_VERSION_1 = _Files(
    "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"
)
_VERSION_2 = _Files("memory.max", "memory.current", "inactive_file")


def _free_in_control_groups(
    root: pathlib.Path = _CONTROL_GROUPS, own: pathlib.Path = _OWN_CONTROL_GROUPS
) -> list[int]:
    """Return the bytes left below each limit of this process's control groups.

    A group's limit also holds for the groups in it. The kernel's cache of files counts
    as free.

    Args:
      root: the folder of all groups.
      own: the file that lists the groups of this process.
    """
    free = []
    try:
        lines = own.read_text().splitlines()
    except OSError:  # Only Linux has control groups.
        return []
    for line in lines:
        _, controllers, path = line.split(":", 2)
        names, top = _VERSION_2, root
        if controllers:
            names, top = _VERSION_1, root / "memory"
            if "memory" not in controllers.split(","):
                continue
        group = top / path.lstrip("/")
        for folder in (group, *group.parents):
            # The group may have no such file, or no limit.
            with contextlib.suppress(OSError, ValueError, LookupError):
                free.append(_free_in(folder, names))
            if folder == top:
                break
    return free


def _free_in(group: pathlib.Path, names: _Files) -> int:
    limit, used = (int((group / x).read_text()) for x in (names.limit, names.used))
    lines = (group / "memory.stat").read_text().splitlines()
    return limit - used + int(dict(map(str.split, lines))[names.cached])


def _padded(count: int, devices: Sequence[jax.Device]) -> int:
    """Return the number of members, rounded up to a multiple of the devices' number."""
    return math.ceil(count / len(devices)) * len(devices)


def check_memory(
    one: Need, config: Config, num_members: int, devices: Sequence[jax.Device]
) -> None:
    """Check that training fits the devices' memory.

    Args:
      one: what one run needs.
      config: PPO's settings of the runs.
      num_members: number of members that are trained at once.
      devices: the devices that they are sharded over, at most one for each member.

    Raises:
      ValueError: if it does not fit; the message gives the sizes.
    """
    used = devices[:num_members]
    required = _padded(num_members, used) * one.memory + len(used) * one.shared
    if (free := available(used)) is not None and required > free:
        # Each device trains the same number of members.
        fit = max(0, free // len(used) - one.shared) // one.memory * len(used)
        if fit == 0:
            alone = _in_words(one.memory + one.shared)
            raise ValueError(
                f"a single seed needs about {alone} of memory, and "
                f"{_in_words(free)} are free: most is for {one.largest_part}"
            )
        sizes = f"num_envs {config.num_envs} and batch_steps {config.batch_steps}"
        raise ValueError(
            f"seeds are {num_members} (over all points): they need about "
            f"{_in_words(required)} of memory, {_in_words(one.memory)} each with "
            f"{sizes}, and {_in_words(free)} are free: at most {fit} fit"
        )


def check_episodes(
    env: Any,
    num_episodes: int,
    num_policies: int,
    devices: Sequence[jax.Device],
    *,
    option: str = "episodes",
) -> None:
    """Check that an evaluation's parallel episodes fit the devices' memory.

    Args:
      env: one environment.
      num_episodes: number of episodes of each policy.
      num_policies: number of policies that are evaluated at once.
      devices: the devices that they are sharded over, at most one for each policy.
      option: name of the option that sets the number of episodes.

    Raises:
      ValueError: if they do not fit; the message gives the sizes.
    """
    state = _size(jax.eval_shape(env.reset, jax.random.key(0)))
    used = devices[:num_policies]
    each, free = _STATES_PER_EPISODE * state * num_episodes, available(used)
    required = _padded(num_policies, used) * each
    if free is not None and required > free:
        raise ValueError(
            f"{option} is {num_episodes}: the episodes of {num_policies} policies at "
            f"once need at least {_in_words(required)} of memory, and "
            f"{_in_words(free)} are free"
        )


def check_disk(
    sizes: Sequence[tuple[int, int]],
    folder: pathlib.Path,
    num_checkpoints: int,
    *,
    written: int = 0,
) -> None:
    """Check that the checkpoints fit the disk.

    Args:
      sizes: of each program the bytes of a member's checkpoint, and the members.
      folder: the folder of the checkpoints; it need not exist.
      num_checkpoints: number of checkpoints to keep of each member.
      written: bytes of the runs' earlier checkpoints, which new ones replace.

    Raises:
      ValueError: if they do not fit; the message gives the sizes.
    """
    while not folder.exists():
        folder = folder.parent
    programs = [size * count for size, count in sizes]
    # While a checkpoint is being written there is one more.
    required = num_checkpoints * sum(programs) + max(programs, default=0)
    free = _free_disk(folder)
    if free is not None and required > free + written:
        members = sum(count for _, count in sizes)
        raise ValueError(
            f"out is in {folder.absolute()}, where {_in_words(free)} are free: "
            f"{num_checkpoints} checkpoints of {members} seeds (over all points), and "
            f"one that is being written, need {_in_words(required)}"
        )


def size_of_checkpoints(folder: pathlib.Path) -> int:
    """Return the bytes of a folder's checkpoints, of which there may be none.

    Damaged ones do not count, because they are kept.
    """
    size = 0
    for path in folder.glob("checkpoints/[0-9]*[0-9]/**/*"):
        # Another process may delete it meanwhile.
        with contextlib.suppress(OSError):
            size += path.stat().st_size if path.is_file() else 0
    return size


def _free_disk(folder: pathlib.Path) -> int | None:
    usage = shutil.disk_usage(folder)
    # A virtual file system such as /proc has no size.
    return usage.free if usage.total else None


def _in_words(number: int) -> str:
    return f"{number / 1e9:.2f} GB" if number >= 1e7 else f"{number / 1e6:.2f} MB"
