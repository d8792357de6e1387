"""Train PPO and PPO+GASIL in your own environment: a pendulum to swing up.

    python docs/examples/own_environment.py --steps 300000

An environment is a class with Brax's interface. `reset` and `step` are pure functions
of one environment; training vmaps them. In this folder the command line trains it too:

    python -m gasil_jax.run --env own_environment:Pendulum
"""

import argparse

import jax
import jax.numpy as jnp
from brax.envs import State

import gasil_jax


class Pendulum:
    """A pendulum that hangs at first; its motor is too weak to lift it in one go."""

    observation_size = 3
    action_size = 1
    action_range = (-1.0, 1.0)
    episode_length = 200
    ends_early = False

    def __init__(self, strength: float = 2.0):
        self.strength = strength

    def reset(self, rng: jax.Array) -> State:
        """Hang at rest, almost straight down; upright is angle 0."""
        angle = jnp.pi + jax.random.uniform(rng, minval=-0.1, maxval=0.1)
        physics = jnp.array([angle, 0.0])
        zero = jnp.float32(0)
        return State(physics, self._observe(physics), zero, zero)

    def step(self, state: State, action: jax.Array) -> State:
        """Turn for 0.05 seconds; the reward is 1 upright and 0 hanging."""
        angle, speed = state.pipeline_state
        acceleration = 15.0 * jnp.sin(angle) + 3.0 * self.strength * action[0]
        speed = jnp.clip(speed + 0.05 * acceleration, -8.0, 8.0)
        physics = jnp.array([angle + 0.05 * speed, speed])
        reward = 0.5 + 0.5 * jnp.cos(physics[0])
        return state.replace(
            pipeline_state=physics, obs=self._observe(physics), reward=reward
        )

    def _observe(self, physics: jax.Array) -> jax.Array:
        angle, speed = physics
        return jnp.array([jnp.cos(angle), jnp.sin(angle), speed / 8.0])


def main() -> None:
    """Print each agent's mean return at the beginning and at the end."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=300_000)
    options = parser.parse_args()

    for agent in ("ppo", "ppo+gasil"):
        algorithm = gasil_jax.algorithm(agent, total_steps=options.steps)
        train = gasil_jax.make_train(Pendulum(), algorithm)
        _, metrics = jax.jit(train)(jax.random.key(0))
        returns = metrics["episode_return"]
        tenth = max(1, len(returns) // 10)
        first, last = jnp.nanmean(returns[:tenth]), jnp.nanmean(returns[-tenth:])
        print(f"{agent}: return {first:.1f} at the start, {last:.1f} at the end")


if __name__ == "__main__":
    main()
