"""Reports of evaluations: metrics, statistics, tables and self-contained web pages."""
