"""Web pages: one look for all of them, no script of their own, nothing loaded from elsewhere."""
