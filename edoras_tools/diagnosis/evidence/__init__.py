"""The evidence that a diagnosis reads from a capture: datagrams, counters, events, clocks and peers."""
