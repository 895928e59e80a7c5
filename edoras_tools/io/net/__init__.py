"""UDP in and out."""
