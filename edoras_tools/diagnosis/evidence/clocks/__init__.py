"""The clocks of captures and of cFS: offset and drift between two, and steps of one."""
