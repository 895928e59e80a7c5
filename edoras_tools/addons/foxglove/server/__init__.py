"""One server of the Foxglove WebSocket protocol, for every command that shows something in Foxglove."""
