"""Agents that only experiments need, written as a user of the package writes them."""
