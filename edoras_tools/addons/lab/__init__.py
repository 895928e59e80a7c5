"""The laboratory: an emulated cFS, the demos that it runs, and the measurement of what a route carries."""
