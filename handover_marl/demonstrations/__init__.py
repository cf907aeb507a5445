"""Episodes as data sets: recorded while they are played, kept in Minari's layout, and read again."""
