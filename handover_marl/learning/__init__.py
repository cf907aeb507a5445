"""Features, action schemes, networks and policy files of learned policies."""
