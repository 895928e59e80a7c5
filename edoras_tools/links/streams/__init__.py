"""What links over TCP need besides their messages; loaded with the first stream."""
