"""Shared settings: two host devices, strict rank promotion in our numeric code."""

import os

os.environ.setdefault("JAX_NUM_CPU_DEVICES", "2")
