"""Configure JAX before it starts: devices, precision, cache of compiled programs."""

import contextlib
import hashlib
import os
import pathlib
import platform
import warnings
from typing import Any

import jax
import jaxlib

from gasil_jax.host import environments
from gasil_jax.host.environments import Settings


def use_devices(settings: Settings, requested: int | None, num_members: int) -> None:
    """Make JAX use the host's cores as devices; call it before JAX starts."""
    count = min(requested or environments.available_cores(), max(1, num_members))
    environments.prepare(settings, count)
    # If the program has used JAX before, the devices stay as they are.
    with contextlib.suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", count)
    _keep_compiled_programs()
    # For all functions, not only those with `full_precision`.
    jax.config.update("jax_default_matmul_precision", "highest")


def _keep_compiled_programs() -> None:
    """Make JAX keep compiled programs in the user's cache, unless it already has one.

    There is a folder for each version of jaxlib and each processor, because a program
    compiled for another one may crash.
    """
    # Older versions report an error for every program that is loaded from the cache.
    quiet = jaxlib.version.__version_info__ >= (0, 12)
    quiet |= os.environ.get("TF_CPP_MIN_LOG_LEVEL", "") >= "3"
    config: Any = jax.config  # Its type does not declare its options.
    if config.jax_compilation_cache_dir is not None or not quiet:
        return
    # Without a home folder `Path.home` raises a RuntimeError.
    with contextlib.suppress(OSError, RuntimeError):
        cpuinfo = pathlib.Path("/proc/cpuinfo")
        lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
        features = {
            x for x in lines if x.startswith(("flags", "Features", "model name"))
        }
        processor = "".join([platform.node(), platform.machine(), *sorted(features)])
        key = hashlib.sha256(processor.encode()).hexdigest()[:16]
        home = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
        folder = pathlib.Path(home, "gasil_jax", f"jaxlib-{jaxlib.__version__}-{key}")
        folder.mkdir(parents=True, exist_ok=True)
        jax.config.update("jax_compilation_cache_dir", str(folder))
        # On some processors no program can be loaded (jax issue 38445), and JAX says so
        # for each, as it does for each that a full disk has no room for.
        failed = "Error (reading|writing) persistent compilation cache"
        warnings.filterwarnings("ignore", failed)
