"""Captures, mission files, what they decode to, and a Foxglove layout."""
