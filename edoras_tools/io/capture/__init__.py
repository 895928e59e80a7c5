"""Live capture: the packet ring, its filters and its devices."""
