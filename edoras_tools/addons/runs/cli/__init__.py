"""Commands about runs of a system."""
