"""Logs of real and simulated drives: commands and poses, read from many formats into one form."""
