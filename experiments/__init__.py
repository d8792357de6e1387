"""Figures and tables of the paper, one module each; run from the project's folder."""

from gasil_jax.host import interruption

interruption.quit_during_imports(__name__)
del interruption
