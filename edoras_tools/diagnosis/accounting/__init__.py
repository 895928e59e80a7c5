"""How many were sent, seen and lost on each hop."""
