"""Scenarios: faults to inject, read from files."""
