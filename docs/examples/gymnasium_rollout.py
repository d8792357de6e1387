"""Run a trained policy in Gymnasium, without JAX.

    python docs/examples/gymnasium_rollout.py runs/hopper Hopper-v5 --episodes 5

The first argument is the folder of a finished run, or its policy.npz.
"""

import argparse

import gymnasium

from gasil_jax import numpy_policy


def main() -> None:
    """Print the return of each episode."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run")
    parser.add_argument("env", help="Gymnasium's name, Hopper-v5")
    parser.add_argument("--episodes", type=int, default=5)
    options = parser.parse_args()

    act = numpy_policy.load(options.run)
    env = gymnasium.make(options.env)
    for episode in range(options.episodes):
        observation, _ = env.reset(seed=episode)
        total, over = 0.0, False
        while not over:
            observation, reward, terminated, truncated, _ = env.step(act(observation))
            total, over = total + float(reward), terminated or truncated
        print(f"episode {episode}: return {total:.1f}")


if __name__ == "__main__":
    main()
