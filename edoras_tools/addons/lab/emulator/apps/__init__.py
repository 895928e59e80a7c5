"""The applications of the emulated cFS."""
