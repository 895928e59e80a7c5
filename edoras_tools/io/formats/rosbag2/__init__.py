"""rosbag2 folders."""
