"""Settings of JAX that must stand before it starts: devices, precision, its cache."""

import contextlib
import hashlib
import os
import pathlib
import platform
from typing import Any

import jax
import jaxlib

from gasil_jax.host import environments
from gasil_jax.host.environments import Settings


def use_devices(settings: Settings, requested: int | None, num_members: int) -> None:
    """Have JAX use the host's cores as devices; call it before JAX starts.

    Args:
      settings: of the environment.
      requested: how many devices; None for the cores.
      num_members: no more devices are used than there are members.
    """
    count = min(requested or environments.available_cores(), num_members)
    environments.prepare(settings, count)
    # In a program that has used JAX already, its devices stay as they are.
    with contextlib.suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", count)
    _keep_compiled_programs()
    # Everywhere, not only where `full_precision` says so.
    jax.config.update("jax_default_matmul_precision", "highest")


def _keep_compiled_programs() -> None:
    """Have JAX keep them in the user's cache, unless its own variable says where.

    By the version of jaxlib and the processor: a program for another one may crash.
    """
    # Before 0.12 XLA calls every program that it loads one for another processor.
    quiet = jaxlib.version.__version_info__ >= (0, 12)
    config: Any = jax.config  # Its options are attributes that its type does not have.
    if config.jax_compilation_cache_dir is not None or not quiet:
        return
    with contextlib.suppress(OSError):
        described = pathlib.Path("/proc/cpuinfo")
        lines = described.read_text().splitlines() if described.exists() else []
        features = {
            x for x in lines if x.startswith(("flags", "Features", "model name"))
        }
        processor = "".join([platform.node(), platform.machine(), *sorted(features)])
        key = hashlib.sha256(processor.encode()).hexdigest()[:16]
        home = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
        folder = pathlib.Path(home, "gasil_jax", f"jaxlib-{jaxlib.__version__}-{key}")
        folder.mkdir(parents=True, exist_ok=True)
        jax.config.update("jax_compilation_cache_dir", str(folder))
