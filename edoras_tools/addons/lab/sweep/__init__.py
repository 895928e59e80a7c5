"""How much a route can carry, found by trying."""
