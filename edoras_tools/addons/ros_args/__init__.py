"""What follows ``--ros-args``: names of nodes and topics, and parameters, as rcl reads them."""
