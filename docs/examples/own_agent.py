"""Train your own agent, which imitates without a discriminator.

    python docs/examples/own_agent.py --steps 300000

PPO's reward is the environment's and a bonus, the higher the closer a step is to the
nearest of 256 steps of the agent's good episodes.
"""

import argparse

import jax
import jax.numpy as jnp

import gasil_jax
from gasil_jax import good_trajectories, normalization
from gasil_jax.imitation.interface import Imitation, leave_policy


def init(key, config, observation_size, action_size):
    """Return the agent's state: it has none."""
    return ()


def update_and_reward(state, context, key):
    """Return the rewards of the batch, (time, env), and a metric."""

    def pairs(observation, action):
        observation = normalization.normalize(context.normalizer, observation)
        return jnp.concatenate([observation, action], axis=-1)

    good = pairs(*good_trajectories.sample(key, context.good_trajectories, 256))
    own = pairs(context.rollout.observation, context.rollout.action)
    squares = jnp.sum((own[:, :, None] - good) ** 2, axis=-1)  # (time, env, 256)
    closeness = jnp.exp(-jnp.sqrt(jnp.min(squares, axis=-1)))
    # The buffer is empty until an episode has ended.
    closeness = jnp.where(context.good_trajectories.size > 0, closeness, 0.0)
    reward = context.rollout.reward + context.hyperparameters.alpha * closeness
    return state, reward, {"closeness": jnp.mean(closeness)}


NEAREST = Imitation(
    init, update_and_reward, leave_policy, fields=("alpha", "buffer_steps")
)


def main() -> None:
    """Print the mean return of PPO and of this agent in the last tenth of training."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="point_mass")
    parser.add_argument("--steps", type=int, default=300_000)
    parser.add_argument("--alpha", type=float, default=0.5)
    options = parser.parse_args()

    env = gasil_jax.make_env(options.env)
    # The second is MODULE:NAME, here and on the command line; this file is the module.
    for agent in ("ppo", "own_agent:NEAREST"):
        config = gasil_jax.Config(agent=agent, total_steps=options.steps)
        train = gasil_jax.make_train(env, config.replace(alpha=options.alpha))
        _, metrics = jax.jit(train)(jax.random.key(0))
        returns = metrics["episode_return"]
        last = jnp.nanmean(returns[-max(1, len(returns) // 10) :])
        print(f"{agent}: return {last:.1f}")


if __name__ == "__main__":
    main()
