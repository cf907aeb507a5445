"""User-defined features and action schemes: declared sizes, checks at run time, and references by text."""
