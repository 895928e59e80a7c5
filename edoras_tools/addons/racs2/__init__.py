"""RACS2, the link between the bridges of ROS 2 and cFS that JAXA made: WebSocket, read and recorded."""
