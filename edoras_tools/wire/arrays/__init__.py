"""Many short stretches of bytes at once: read, copied, summed, sorted and compared as columns."""
