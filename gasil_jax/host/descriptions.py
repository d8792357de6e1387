"""Algorithms as plain values, by name: for config.json, trackers and stored runs.

Here names become objects: an agent is one of the package's, or MODULE:CLASS.
"""

from collections.abc import Mapping
from typing import Any, get_type_hints

from gasil_envs import user_code
from gasil_jax.agents import AGENTS, Agent
from gasil_jax.algorithms import Algorithm, check
from gasil_jax.config import names
from gasil_jax.errors import InputError, NotImportable, refusal, unknown
from gasil_jax.host import json_files
from gasil_jax.rewards import REWARD_MODELS


def find_agent(name: Any) -> type[Agent]:
    """Return the class of an agent's name."""
    if not isinstance(name, str):
        raise refusal("agent", name, "a string")
    if ":" not in name:
        if name not in AGENTS:
            raise ValueError(
                unknown("agent", name, tuple(AGENTS), forms=["MODULE:CLASS"])
            )
        return AGENTS[name]
    try:
        agent = user_code.find("agent", name)
    except ValueError as error:
        raise NotImportable(str(error)) from None
    if not (isinstance(agent, type) and issubclass(agent, Agent)):
        raise ValueError(
            f"agent {name!r} is of type {type(agent).__name__}: it must be a class "
            "that is derived from gasil_jax.Agent"
        )
    # In config.json it has its own name.
    if agent.name != name:
        raise ValueError(
            f"agent {name!r} calls itself {agent.name!r}: name the module that "
            "defines the class, or remove the class's attribute `name`"
        )
    with user_code.refused(f"agent {name!r} can't be made", passing=ValueError):
        check(Algorithm(agent()))
    return agent


def describe(algorithm: Algorithm) -> dict[str, Any]:
    """Return the agent's name and every setting by name."""
    return {"agent": algorithm.agent.name, **algorithm.settings}


def read(values: Mapping[str, Any]) -> Algorithm:
    """Return the algorithm that `describe` describes, also after a way through JSON.

    Settings that are missing have their defaults.
    """
    if "agent" not in values:
        raise InputError("agent is missing")
    settings = dict(values)
    agent = find_agent(settings.pop("agent"))
    algorithm = Algorithm(agent())
    switches = {
        model.switch: json_files.as_type(
            bool, settings.pop(model.switch, False), model.switch
        )
        for model in REWARD_MODELS
    }
    algorithm = algorithm.replace(**switches)
    kinds: dict[str, Any] = {}
    for part in algorithm.parts:
        hints = get_type_hints(type(part))
        kinds |= {name: hints[name] for name in names(part)}
    for name in settings:
        if name not in kinds:
            raise InputError(algorithm.why_not(name))
    return algorithm.replace(
        **{
            name: json_files.as_type(kinds[name], value, name)
            for name, value in settings.items()
        }
    )
