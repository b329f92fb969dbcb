"""Conversion of a real robot's logs to episodes: CSV, Parquet, MCAP and ROS bags."""
