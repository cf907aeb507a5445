"""Data sets in LeRobot's format v3: Parquet files, videos and metadata at a constant frame rate."""
