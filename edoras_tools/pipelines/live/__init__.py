"""A link or a recording, live in Foxglove."""
