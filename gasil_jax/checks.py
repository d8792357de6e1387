"""Whether an algorithm can train in an environment, before anything compiles.

These are the checks at the door of Python: `make_train`, `init` and `fit` call them.
What is behind the door trusts its arguments.
"""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp

from gasil_envs import user_code, user_environment
from gasil_jax import algorithms, networks
from gasil_jax.agents import Agent
from gasil_jax.algorithms import Algorithm
from gasil_jax.context import Sizes, sizes_of
from gasil_jax.errors import shown


def check(env: Any, algorithm: Algorithm) -> None:
    """Raise `ValueError` if the algorithm can't train in the environment.

    Nothing is compiled, and only networks of the user's own are traced.
    """
    _check_interface(env)
    algorithms.check(algorithm)
    agent, config = algorithm.agent, algorithm.config
    sizes = sizes_of(env, config.num_envs)
    with user_code.refused(f"check of agent {agent.name!r} fails", passing=ValueError):
        agent.check(sizes)
    _check_networks(agent, sizes)
    own = type(agent).policy_network is not Agent.policy_network
    if config.policy_components > 1 and (sizes.discrete or own):
        why = f"agent {agent.name!r} has a policy_network of its own, with one mean"
        why = "the environment's actions are discrete" if sizes.discrete else why
        raise ValueError(
            f"policy_components is {config.policy_components}: it must be 1, {why}"
        )


def check_environment(env: Any) -> None:
    """Raise `ValueError` if an environment, which is traced, does not fit training."""
    _check_interface(env)
    *_, innermost = _levels(env)
    # Ours and Brax's need no check.
    if not type(innermost).__module__.startswith(("gasil_envs.", "brax.envs.")):
        user_environment.check(type(innermost).__name__, env, env)


def _check_networks(agent: Any, sizes: Sizes) -> None:
    """Raise `ValueError` if a network of the user's own returns a wrong shape."""
    observation = jnp.zeros((2, sizes.observation))
    action = jnp.zeros((2, sizes.action))
    for function, arguments, inputs, shape in (
        ("policy_network", (sizes,), (observation,), (2, sizes.action)),
        ("value_network", (sizes,), (observation,), (2,)),
        ("discriminator_network", (), (observation, action), (2,)),
    ):
        what = f"{function} of agent {agent.name!r}"
        with user_code.refused(f"{what} fails"):
            network = getattr(agent, function, lambda *_: None)(*arguments)
            if network is None or type(network).__module__ == networks.__name__:
                continue
            key = jax.random.key(0)
            output, variables = jax.eval_shape(network.init_with_output, key, *inputs)
        leaves = jax.tree.leaves(output)
        given = " and ".join(f"{x.dtype}{list(x.shape)}" for x in leaves)
        if given != (expected := f"float32{list(shape)}"):
            raise ValueError(
                f"{what} returns {given} for 2 steps: it must be {expected}"
            )
        if set(variables) != {"params"}:
            raise ValueError(
                f"{what} has {', '.join(sorted(variables))}: it must have params alone"
            )


def _check_interface(env: Any) -> None:
    """Raise `ValueError` unless the environment has Brax's interface, in float32."""
    if isinstance(env, type):
        raise ValueError(
            f"env is the class {env.__name__}: it must be an instance, {env.__name__}()"
        )
    if (lacking := user_environment.missing(env)) is not None:
        raise ValueError(
            f"env is {shown(env)}, which has no {lacking}: it must be an environment "
            "with Brax's interface, as gasil_jax.make_env gives"
        )
    # The value of a truncated episode would be bootstrapped from the next one's start.
    for level in _levels(env):
        if "AutoReset" in (name := type(level).__name__):
            raise ValueError(
                f"env is wrapped in {name}: it must not reset itself (for a Brax "
                "environment use brax.envs.get_environment)"
            )
    if jax.config.read("jax_enable_x64"):
        raise ValueError("jax_enable_x64 is True: training is in float32, unset it")


def _levels(env: Any) -> Iterator[Any]:
    """Yield an environment, what it wraps, and so on down to the innermost one."""
    level = env
    while level is not None:
        yield level
        # `getattr` would skip levels: wrappers forward attributes of what they wrap.
        level = getattr(level, "__dict__", {}).get("env")
