"""What policies are, how one is named, and how it is made."""
