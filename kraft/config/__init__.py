"""Configuration files: readers that keep the position of every value, validation, and the bundled files."""
