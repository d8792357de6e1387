"""Raise `ImportError` on Windows, and for a jaxlib that computes wrong numbers."""

import contextlib
import importlib.metadata
import sys

#: Releases that compute batched reductions wrongly on a CPU (jax issue 39103).
_MISCOMPILES = ("0.10.2",)


def check(jaxlib_version: str) -> None:
    """Raise `ImportError` for a release that computes wrong numbers."""
    if jaxlib_version in _MISCOMPILES:
        raise ImportError(
            f"jaxlib {jaxlib_version} gives wrong numbers on a CPU (jax issue 39103): "
            "install another one, 0.10.1 or 0.12 and later"
        )


if sys.platform == "win32":
    raise ImportError("gasil_jax runs on Linux and macOS: on Windows, use WSL")
with contextlib.suppress(importlib.metadata.PackageNotFoundError):
    check(importlib.metadata.version("jaxlib"))
