"""Recordings without datagrams, as other tools make them: opened as one source of messages, and counted."""
