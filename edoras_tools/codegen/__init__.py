"""C99 for flight software without ROS, generated from ROS message definitions."""
