"""Figures and tables of the paper, one module each; run from the project's folder."""
