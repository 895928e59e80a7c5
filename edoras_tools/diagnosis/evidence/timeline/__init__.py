"""What a cFS, its applications and its links were told, and what state they were in, over time."""
