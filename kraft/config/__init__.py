"""Configuration files: YAML with the position of every value, schemas, and the files that come with kraft."""
