"""Refuse, on import, releases of jaxlib that compute wrong numbers."""

import contextlib
import importlib.metadata

#: Releases that compute batched reductions wrongly on a CPU (jax issue 39103).
_MISCOMPILES = ("0.10.2",)


def check(jaxlib_version: str) -> None:
    """Raise `ImportError` for a release that computes wrong numbers."""
    if jaxlib_version in _MISCOMPILES:
        raise ImportError(
            f"jaxlib {jaxlib_version} gives wrong numbers on a CPU (jax issue 39103): "
            "install another one, 0.10.1 or 0.12 and later"
        )


with contextlib.suppress(importlib.metadata.PackageNotFoundError):
    check(importlib.metadata.version("jaxlib"))
