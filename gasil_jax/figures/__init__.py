"""Curves and statistics of finished runs."""
