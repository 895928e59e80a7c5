"""pcapng files."""
