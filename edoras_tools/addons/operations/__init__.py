"""What runs around a recorder need: figures for Prometheus, and a command for each complete file."""
