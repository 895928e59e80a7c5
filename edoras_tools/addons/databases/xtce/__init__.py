"""XTCE, as ground systems have it (OMG formal/2018-10-04)."""
