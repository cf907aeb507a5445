"""Receiver `reactive`, which follows the moving object; it uses the true poses of the object and the person's hand."""
