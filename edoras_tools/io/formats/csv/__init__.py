"""Comma-separated values (RFC 4180): one header line, one line a row."""
