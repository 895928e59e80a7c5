"""What a capture holds that the diagnosis concludes from: counters' packets, events, clocks, peers."""
