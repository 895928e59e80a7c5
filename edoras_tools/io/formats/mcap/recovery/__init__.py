"""What a recovery of MCAP files is made of: the search for records, summaries, channels, the report."""
