"""The error for bad input, and its wording, which are those of `gasil_envs`."""

from gasil_envs.errors import (
    InputError,
    NotImportable,
    did_you_mean,
    nearest,
    refusal,
    shown,
    unknown,
)

__all__ = [
    "InputError",
    "NotImportable",
    "did_you_mean",
    "nearest",
    "refusal",
    "shown",
    "unknown",
]
