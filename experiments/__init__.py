"""Figures and tables of the paper, and what else is measured, of a checkout."""

from gasil_jax.host import interruption

if interruption.runs_as_program(__name__):
    interruption.quit_during_imports()
del interruption
