"""Figures and tables of the paper, one module each; run from the project's folder."""

from gasil_jax.host import interruption

if interruption.runs_as_program(__name__):
    interruption.quit_during_imports()
del interruption
