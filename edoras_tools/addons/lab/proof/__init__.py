"""``edoras doctor --prove``: a capture's own input through the emulated cFS, with its advice and without."""
