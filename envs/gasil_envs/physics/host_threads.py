"""The threads of host calls, on which physics "mujoco" runs. MuJoCo is not imported."""

import os

import jax

# JAX copies a host call's arguments on the threads that its CPU devices compute with.
# Before jax 0.12 copies of large arguments wait for ever if all threads are in calls.
_POOL_SIZE = "PJRT_NPROC"
_NEEDS_THREADS = tuple(map(int, jax.__version__.split(".")[:2])) < (0, 12)


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def reserve(num_devices: int) -> None:
    """Let `num_devices` CPU devices make host calls at once; call before JAX starts."""
    if _NEEDS_THREADS and num_devices > 1:
        os.environ.setdefault(_POOL_SIZE, str(2 * num_devices))


def check() -> None:
    """Raise `RuntimeError` where host calls would wait for ever."""
    devices = jax.local_device_count()
    threads = int(os.environ.get(_POOL_SIZE, available_cores()))
    on_cpu = jax.default_backend() == "cpu"
    if _NEEDS_THREADS and on_cpu and devices > 1 and threads <= devices:
        raise RuntimeError(
            f"physics 'mujoco' on {devices} CPU devices would deadlock in jax "
            f"{jax.__version__}: set {_POOL_SIZE}={2 * devices} before JAX starts"
        )
