"""The same message found again on another link or in another capture."""
