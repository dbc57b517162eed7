"""Drive fast and never hit anything, knowing only an approximate model of yourself."""
