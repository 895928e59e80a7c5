"""The commands that write code and packet descriptions."""
