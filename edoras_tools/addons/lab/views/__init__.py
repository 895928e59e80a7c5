"""Views of the demos."""
