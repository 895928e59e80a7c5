"""ROS 2 over DDS, compatible with rmw_cyclonedds and rmw_fastrtps."""
