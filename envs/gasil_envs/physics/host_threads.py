"""The threads of host calls, on which physics "mujoco" runs. MuJoCo is not imported."""

import contextlib
import math
import os
import pathlib
from collections.abc import Iterator

import jax

# JAX copies a host call's arguments on the threads that its CPU devices compute with.
# Before jax 0.12 copies of large arguments wait for ever if all threads are in calls.
_POOL_SIZE = "PJRT_NPROC"
_NEEDS_THREADS = tuple(map(int, jax.__version__.split(".")[:2])) < (0, 12)


def available_cores(
    root: pathlib.Path = pathlib.Path("/sys/fs/cgroup"),
    own: pathlib.Path = pathlib.Path("/proc/self/cgroup"),
) -> int:
    """Return the number of cores that this process may use.

    A container's share of CPUs, which control groups limit, is rounded up.
    """
    return min([_schedulable_cores(), *map(math.ceil, _cpu_limits(root, own))])


def _schedulable_cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _cpu_limits(root: pathlib.Path, own: pathlib.Path) -> Iterator[float]:
    """Yield the CPUs that each control group of this process may use."""
    try:
        lines = [line.split(":", 2) for line in own.read_text().splitlines()]
    except OSError:  # Only Linux has control groups.
        return
    # The second version has one hierarchy, the first one for each resource.
    groups = {x: path for _, kinds, path in lines for x in kinds.split(",")}
    for kind, names in (
        ("", ("cpu.max",)),
        ("cpu", ("cpu.cfs_quota_us", "cpu.cfs_period_us")),
    ):
        top = root / kind
        group = top / groups.get(kind, "").lstrip("/")
        for folder in (group, *group.parents):
            # A group without a limit has "max" or -1.
            with contextlib.suppress(OSError, ValueError):
                text = " ".join((folder / name).read_text() for name in names)
                quota, period = map(int, text.split())
                if quota > 0:
                    yield quota / period
            if folder == top:
                break


def reserve(num_devices: int) -> None:
    """Let `num_devices` CPU devices make host calls at once; call before JAX starts."""
    if _NEEDS_THREADS and num_devices > 1:
        os.environ.setdefault(_POOL_SIZE, str(2 * num_devices))


def check() -> None:
    """Raise `RuntimeError` where host calls would wait for ever."""
    devices = jax.local_device_count()
    threads = int(os.environ.get(_POOL_SIZE, _schedulable_cores()))
    on_cpu = jax.default_backend() == "cpu"
    if _NEEDS_THREADS and on_cpu and devices > 1 and threads <= devices:
        raise RuntimeError(
            f"physics 'mujoco' on {devices} CPU devices would deadlock in jax "
            f"{jax.__version__}: set {_POOL_SIZE}={2 * devices} before JAX starts"
        )
