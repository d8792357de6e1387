"""The commands: each reads its options, and leaves the work to `host`."""

import os
import sys

# XLA reads it on import. Before jaxlib 0.12 it reports an error for each program that
# it loads from the cache.
if "jax" not in sys.modules:
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
