"""What learning needs beside the environment: features, action schemes, small networks, policy files."""
