"""Descriptions of the packets of a mission for ground systems: XTCE, and COSMOS."""
