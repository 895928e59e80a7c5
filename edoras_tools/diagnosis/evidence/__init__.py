"""What a diagnosis reads from a capture: counters, events, clocks and peers."""
