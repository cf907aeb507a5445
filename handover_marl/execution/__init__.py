"""Worker processes on one machine or a Ray cluster, and safe reading and writing of files."""
