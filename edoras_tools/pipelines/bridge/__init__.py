"""Bridges between ROS 2 and cFS."""
