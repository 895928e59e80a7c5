"""XTCE, as ground systems use it (OMG formal/2018-10-04)."""
