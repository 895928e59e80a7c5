"""A Software Bus Network (SBN) peer, as a machine without sockets or clocks."""
