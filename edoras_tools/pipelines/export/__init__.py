"""Exports topics as tables: to files for other programs, or to arrays in Python."""
