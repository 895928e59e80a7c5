"""A relay between a ground system and cFS."""
