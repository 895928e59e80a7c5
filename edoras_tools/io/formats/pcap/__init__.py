"""Classic pcap files."""
