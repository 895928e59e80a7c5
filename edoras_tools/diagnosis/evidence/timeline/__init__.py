"""The states of each cFS, its applications and its links over time, and the commands that change them."""
