"""What a recording contains of a batch: datagrams, messages, events, statistics."""
