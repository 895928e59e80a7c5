"""What stands between a sender and a receiver: proxies, relays, address translation."""
