"""The panes: lists that draw only the lines on the screen."""
