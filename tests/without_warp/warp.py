"""Stands for Warp where it is not installed."""

raise ImportError("Warp is hidden from tests")
