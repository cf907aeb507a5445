"""Features and action schemes of many episodes at once, on arrays with the episode as first axis."""
