"""cFS's own C structs: where their members lie, and their bytes as named values."""
