"""Figures and tables of the paper, and what else is measured, of a checkout."""
