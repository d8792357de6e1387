"""A training that takes seconds, as a config and as flags of the command line."""

import gasil_jax

CONFIG = gasil_jax.Config(
    total_steps=256,
    num_envs=4,
    batch_steps=128,
    minibatch_size=32,
    num_epochs=1,
    hidden_sizes=(8,),
    discriminator_hidden_sizes=(8,),
)
#: A flag that follows replaces an earlier one, but for the widths of layers.
FLAGS = (
    *("--env", "point_mass", "--total-steps", "256", "--num-envs", "4"),
    *("--batch-steps", "128", "--minibatch-size", "32", "--num-epochs", "1"),
    *("--hidden-sizes", "8", "--discriminator-hidden-sizes", "8"),
)
