"""A training that takes seconds, as settings and as flags of the command line."""

#: Settings that every agent has.
SETTINGS = {
    "total_steps": 256,
    "num_envs": 4,
    "batch_steps": 128,
    "minibatch_size": 32,
    "num_epochs": 1,
    "hidden_sizes": (8,),
}
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
