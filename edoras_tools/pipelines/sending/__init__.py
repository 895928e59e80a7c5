"""Replay and inject: what is sent, when, and what comes back."""
