"""Logs of a real robot, read into episodes: CSV, Parquet, MCAP and ROS bags."""
