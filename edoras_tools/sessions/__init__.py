"""State machines of the flight side and its bridges: bytes and times in, bytes and events out.

No sockets, no clocks, no files: time is an argument, integer ns. The caller decides whether the time is real.
"""
