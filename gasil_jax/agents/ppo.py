"""No imitation: PPO alone."""

from gasil_jax.agents.interface import Agent


class PPO(Agent):
    """PPO on the environment's reward. It keeps no trajectories."""

    name = "ppo"
