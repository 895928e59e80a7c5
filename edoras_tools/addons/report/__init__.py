"""A diagnosis as one self-contained HTML page: no network, no scripts needed to read it."""
