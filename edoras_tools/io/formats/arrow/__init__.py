"""Apache Arrow: its files, and Parquet, which the same library writes; pyarrow, an extra."""
