"""Views of bridges and of a Foxglove server."""
