"""Curves of finished runs."""
