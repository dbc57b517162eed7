"""The `kraft` command line."""
