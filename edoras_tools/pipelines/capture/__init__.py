"""Read, choose, act: record, sniff, info and what counts on the way."""
