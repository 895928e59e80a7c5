"""Reads fields, rates, losses and events of recordings as lines over time."""
