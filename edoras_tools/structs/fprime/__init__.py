"""F Prime's dictionaries: commands, channels and events as structs, and where packets hold them."""
