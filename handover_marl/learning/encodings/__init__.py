"""User-defined features and action schemes: declared sizes, checks of values, and names `module:name`."""
