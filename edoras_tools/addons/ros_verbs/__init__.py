"""What users of ROS 2 know: echo, bw, delay, topic and play, over a graph, a link or a file; and observe."""
