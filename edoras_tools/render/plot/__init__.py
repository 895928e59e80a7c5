"""Plots of fields over time: in the terminal, as SVG, as one HTML page."""
