"""Adapters from functions, PyTorch modules and files of other libraries to policies."""
