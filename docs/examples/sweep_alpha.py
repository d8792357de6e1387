"""Train four values of alpha with several seeds each as one program, and plot them.

    python docs/examples/sweep_alpha.py --env walker2d --steps 1000000 --seeds 10

Alpha is the weight of the discriminator's reward.
"""

import argparse

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import gasil_jax


def sweep(env, algorithm, alphas, num_seeds):
    """Return the metrics, (alpha, seed, iteration) each."""
    train = gasil_jax.make_train(env, algorithm)
    keys = jax.random.split(jax.random.key(0), num_seeds)

    def train_seeds(alpha):
        return jax.vmap(lambda key: train(key, {"alpha": alpha}))(keys)

    _, metrics = jax.jit(jax.vmap(train_seeds))(jnp.asarray(alphas))
    return metrics


def main() -> None:
    """Train, print the final returns and write the plot."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="point_mass")
    parser.add_argument("--reward-delay", type=int, default=1)
    parser.add_argument("--steps", type=int, default=200_000, help="of each seed")
    parser.add_argument("--seeds", type=int, default=4, help="for each alpha")
    parser.add_argument("--out", default="alpha.png")
    options = parser.parse_args()

    delay = options.reward_delay
    env = gasil_jax.make_env(options.env, reward_delay=delay)
    algorithm = gasil_jax.preset(options.env, "ppo+gasil", reward_delay=delay)
    algorithm = algorithm.replace(total_steps=options.steps)
    alphas = (0.0, 0.1, 0.3, 1.0)
    metrics = sweep(env, algorithm, alphas, options.seeds)

    axes = plt.figure(layout="constrained").subplots()
    config = algorithm.config
    steps = config.batch_steps * np.arange(1, config.num_iterations + 1)
    for alpha, returns in zip(alphas, np.asarray(metrics["episode_return"])):
        # Iterations in which no episode ended have no return.
        mean = np.nanmean(returns, axis=0)
        axes.plot(steps, mean, label=f"alpha {alpha:g}")
        print(f"alpha {alpha:g}: return {mean[-1]:.1f}")
    axes.set(xlabel="steps of a seed", ylabel="mean return over seeds")
    axes.legend()
    plt.savefig(options.out)


if __name__ == "__main__":
    main()
