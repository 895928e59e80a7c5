"""The core services of the emulated cFS, as machines without sockets or clocks."""
