"""Expectations about a capture: read from a file, checked, drafted from a good run, reported as JUnit XML."""
