"""The commands: each reads its options, and leaves the work to `host`."""

import os
import signal
import sys

# XLA reads it on import. Before jaxlib 0.12 it reports an error for each program that
# it loads from the cache.
if "jax" not in sys.modules:
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

_spec = getattr(sys.modules["__main__"], "__spec__", None)
#: Whether this process runs a command, and not somebody's own program.
IS_PROGRAM = _spec is not None and _spec.name.startswith("gasil_jax.")


def quit_at_once(number: int, frame: object) -> None:
    """Answer a signal during imports, which would be a traceback, or passed by."""
    os.write(2, b"interrupted\n")
    os._exit(128 + number)


if IS_PROGRAM and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, quit_at_once)
