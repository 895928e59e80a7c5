"""Diagnosis, comparison and report of captures."""
