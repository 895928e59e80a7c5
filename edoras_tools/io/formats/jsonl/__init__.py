"""JSON Lines (https://jsonlines.org): one object a row."""
