"""Train your own agent, which imitates without a discriminator.

    python docs/examples/own_agent.py --steps 300000

PPO's reward is the environment's and a bonus, the higher the closer a step is to the
nearest of 256 steps of the agent's good episodes.
"""

import argparse

import jax
import jax.numpy as jnp

import gasil_jax
from gasil_jax import buffer, normalization
from gasil_jax.agents.buffered import BufferedAgent
from gasil_jax.config import number


class Nearest(BufferedAgent):
    """PPO on the environment's reward and a bonus for steps close to good ones.

    Attributes:
      closeness_weight: the bonus of a step that is equal to a good one.
    """

    closeness_weight: float = number(0.5, low=0.0)

    def update_and_reward(self, state, context, key):
        """Return the state, the rewards of the batch, (time, env), and a metric."""

        def pairs(observation, action):
            observation = normalization.normalize(context.normalizer, observation)
            return jnp.concatenate([observation, action], axis=-1)

        good = pairs(*buffer.sample(key, state.buffer, 256))
        own = pairs(context.rollout.observation, context.rollout.action)
        squares = jnp.sum((own[:, :, None] - good) ** 2, axis=-1)  # (time, env, 256)
        closeness = jnp.exp(-jnp.sqrt(jnp.min(squares, axis=-1)))
        # The buffer is empty until an episode has ended.
        closeness = jnp.where(state.buffer.size > 0, closeness, 0.0)
        reward = context.rollout.reward + self.closeness_weight * closeness
        return state, reward, {"closeness": jnp.mean(closeness)}


def main() -> None:
    """Print the mean return of PPO and of this agent in the last tenth of training."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="point_mass")
    parser.add_argument("--steps", type=int, default=300_000)
    parser.add_argument("--closeness-weight", type=float, default=0.5)
    options = parser.parse_args()

    env = gasil_jax.make_env(options.env)
    config = gasil_jax.Config(total_steps=options.steps)
    for agent in (gasil_jax.PPO(), Nearest(closeness_weight=options.closeness_weight)):
        algorithm = gasil_jax.Algorithm(agent, config=config)
        train = gasil_jax.make_train(env, algorithm)
        _, metrics = jax.jit(train)(jax.random.key(0))
        returns = metrics["episode_return"]
        last = jnp.nanmean(returns[-max(1, len(returns) // 10) :])
        print(f"{type(agent).__name__}: return {last:.1f}")


if __name__ == "__main__":
    main()
