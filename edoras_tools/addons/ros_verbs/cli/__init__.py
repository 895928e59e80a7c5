"""The commands: one file for those that ``ros2 topic`` has, one for each other."""
