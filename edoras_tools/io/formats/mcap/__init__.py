"""MCAP: the reader, the writer of chunks, and recovery."""
