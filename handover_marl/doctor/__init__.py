"""What is installed and what of a data folder is there, for `handover-marl doctor`."""
