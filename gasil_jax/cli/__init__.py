"""The commands: ``python -m gasil_jax.run`` and the others."""
