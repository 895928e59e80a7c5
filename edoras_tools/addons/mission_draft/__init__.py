"""Drafts a mission file from a capture."""
