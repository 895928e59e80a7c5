"""ROS message definitions: their grammar, where they are found, their fields and their text."""
