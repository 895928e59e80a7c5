"""RTPS: the wire protocol of DDS: read, put together from fragments, recorded, and judged."""
