"""Algorithms as plain values, by name: for config.json, trackers and stored runs.

Here names become objects: an agent is one of the package's, or MODULE:CLASS; of models
of rewards your own are MODULE:CLASS.
"""

from collections.abc import Mapping
from typing import Any, get_type_hints

from gasil_envs import user_code
from gasil_jax.agents import AGENTS, Agent
from gasil_jax.algorithms import Algorithm, check
from gasil_jax.config import names
from gasil_jax.errors import InputError, NotImportable, refusal, unknown
from gasil_jax.host import json_files
from gasil_jax.rewards import REWARD_MODELS, RewardModel


def find_agent(name: Any) -> type[Agent]:
    """Return the class of an agent's name."""
    if isinstance(name, str) and ":" not in name:
        if name not in AGENTS:
            raise ValueError(
                unknown("agent", name, tuple(AGENTS), forms=["MODULE:CLASS"])
            )
        return AGENTS[name]
    agent: type[Agent] = _find("agent", name, Agent)
    with user_code.refused(f"agent {name!r} can't be made", passing=ValueError):
        check(Algorithm(agent()))
    return agent


def find_model(name: Any) -> type[RewardModel]:
    """Return the class of the name of one's own model of rewards."""
    model: type[RewardModel] = _find("rewards", name, RewardModel)
    if model in REWARD_MODELS:
        raise ValueError(f"rewards is {name!r}: use {model.switch} instead")
    with user_code.refused(f"rewards {name!r} can't be made", passing=ValueError):
        check(Algorithm(Agent(), (model(),)))
    return model


def _find(kind: str, name: Any, base: Any) -> Any:
    """Return the class that MODULE:CLASS names, which is derived from another one."""
    if not isinstance(name, str) or ":" not in name:
        raise refusal(kind, name, "MODULE:CLASS")
    try:
        found = user_code.find(kind, name)
    except ValueError as error:
        raise NotImportable(str(error)) from None
    is_derived = isinstance(found, type) and issubclass(found, base)
    if not is_derived:
        raise ValueError(
            f"{kind} {name!r} is of type {type(found).__name__}: it must be a class "
            f"that is derived from gasil_jax.{base.__name__}"
        )
    # In config.json it has its own name.
    if found.name != name:
        raise ValueError(
            f"{kind} {name!r} calls itself {found.name!r}: name the module that "
            "defines the class, or remove the class's attribute `name`"
        )
    return found


def describe(algorithm: Algorithm) -> dict[str, Any]:
    """Return the names of the agent and of one's own models, and every setting."""
    own = tuple(model.name for model in algorithm.own_models)
    values = {
        x: "a function" if callable(y) else y for x, y in algorithm.settings.items()
    }
    return {"agent": algorithm.agent.name, "rewards": own, **values}


def read(values: Mapping[str, Any]) -> Algorithm:
    """Return what `describe` describes; settings that are missing have defaults."""
    if "agent" not in values:
        raise InputError("agent is missing")
    settings = dict(values)
    agent = find_agent(settings.pop("agent"))
    own = json_files.as_type(tuple[str, ...], settings.pop("rewards", ()), "rewards")
    algorithm = Algorithm(agent(), tuple(find_model(name)() for name in own))
    switches = {x.switch: settings.pop(x.switch, False) for x in REWARD_MODELS}
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
