"""Views of an archive's index."""
