"""CCSDS transfer frames: TM (132.0-B-3), AOS (732.0-B-4), TC (232.0-B-4)."""
