"""CDR, the bytes of ROS messages: to values one by one, and to columns for many messages at a time."""
