"""Shared settings: two host devices and a cache, before anything starts JAX."""

import atexit
import os
import shutil
import tempfile

os.environ.setdefault("JAX_NUM_CPU_DEVICES", "2")
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    # Of this session alone; its workers and the programs that it starts share it.
    _cache = tempfile.mkdtemp(prefix="gasil-jax-tests-")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _cache
    atexit.register(shutil.rmtree, _cache, ignore_errors=True)

from gasil_envs.physics import native

native.reserve_threads(2)
