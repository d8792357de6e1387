"""A training that takes seconds, as settings and as flags, and policies of none."""

import csv
import pathlib

import jax
import numpy as np

import gasil_jax

#: Settings that every agent has.
SETTINGS = {"total_steps": 256, "num_envs": 4, "batch_steps": 128, "num_epochs": 1}
SETTINGS |= {"minibatch_size": 32, "hidden_sizes": (8,)}
#: The same as flags. A flag that follows replaces an earlier one, but for the widths of
#: layers.
FLAGS = (
    *("--env", "point_mass", "--total-steps", "256", "--num-envs", "4"),
    *("--batch-steps", "128", "--minibatch-size", "32", "--num-epochs", "1"),
    *("--hidden-sizes", "8"),
)
#: For agents with a discriminator.
DISCRIMINATOR = {"discriminator_hidden_sizes": (8,)}
DISCRIMINATOR_FLAGS = ("--discriminator-hidden-sizes", "8")
#: Four iterations of the discriminator's agent. Of four members, as the run below has
#: with the padding for two devices, all have one compiled program.
SMALL = (
    *(*FLAGS, *DISCRIMINATOR_FLAGS, "--total-steps", "1e3", "--batch-steps", "256"),
    *("--num-epochs", "2", "--buffer-steps", "300", "--discriminator-updates", "3"),
    *("--alpha", "0.5", "--alpha-schedule", "0", "0.5", "500", "1"),
    *("--learning-rate", "3e-4", "--first-seed", "5"),
)
#: Two points, of one program with two seeds. The second's first step is beyond float32.
GRID = ("--grid", "learning_rate=3e-4,1e30")


def drawn_policies(env, algorithm, count, *, whole=False):
    """States of `count` runs, of which policies and normalizers are drawn, not trained.

    If they are not asked for as a whole, all else are shapes, and nothing is compiled.
    """
    init = jax.vmap(lambda seed: gasil_jax.init(env, algorithm, jax.random.key(seed)))
    seeds = np.arange(count, dtype=np.uint32)
    states = jax.jit(init)(seeds) if whole else jax.eval_shape(init, seeds)
    rng = np.random.default_rng(0)
    draw = lambda x: (0.5 * rng.normal(size=x.shape)).astype(x.dtype)
    learner = states.actor_critic.policy
    learner = learner.replace(params=jax.tree.map(draw, learner.params))
    return states.replace(
        actor_critic=states.actor_critic.replace(policy=learner),
        normalizer=jax.tree.map(lambda x: 1 + draw(x) ** 2, states.normalizer),
    )


def table(path):
    """The rows of a CSV file."""
    with pathlib.Path(path).open() as file:
        return list(csv.DictReader(file))
