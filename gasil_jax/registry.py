"""The agents by name: the package's own, and those that MODULE:NAME names."""

import importlib
from typing import Any

from gasil_jax.errors import NotImportable, unknown

#: The package's own agents, `Imitation`s by name; `gasil_jax.imitation` fills it.
AGENTS: dict[str, Any] = {}

_FUNCTIONS = ("init", "update_and_reward", "update_policy", "mix", "check")


def find(name: Any) -> Any:
    """Return the `Imitation` of an agent's name.

    Args:
      name: a key of `AGENTS`, or MODULE:NAME of an agent of your own.

    Raises:
      ValueError: if the name is unknown, or if it names no `Imitation`.
    """
    if not isinstance(name, str):
        raise ValueError(f"agent is {name!r}: it must be a string")
    if ":" not in name:
        importlib.import_module("gasil_jax.imitation")  # It fills `AGENTS`.
        if name not in AGENTS:
            raise ValueError(unknown("agent", name, tuple(AGENTS), ["MODULE:NAME"]))
        return AGENTS[name]
    from gasil_envs import own_code

    try:
        agent = own_code.find("agent", name)
    except ValueError as error:
        raise NotImportable(str(error)) from None
    if not all(callable(getattr(agent, function, None)) for function in _FUNCTIONS):
        raise ValueError(
            f"agent {name!r} is of type {type(agent).__name__}: it must be an Imitation"
        )
    return agent
