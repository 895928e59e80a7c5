"""Runs of a system: held to expectations, and against each other."""
