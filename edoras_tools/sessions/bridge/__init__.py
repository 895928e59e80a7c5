"""The ground bridge and what both bridges share, as machines without sockets or clocks."""
