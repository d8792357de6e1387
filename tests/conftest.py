"""Shared settings: two host devices, before anything starts JAX."""

import os

os.environ.setdefault("JAX_NUM_CPU_DEVICES", "2")

from gasil_envs.physics import native

native.reserve_threads(2)
