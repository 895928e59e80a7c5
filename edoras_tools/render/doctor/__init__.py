"""Views of a diagnosis: on the terminal and as a page."""
