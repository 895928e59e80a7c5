"""The clocks of captures and of cFS: aligned, with offset and drift, and made steady."""
