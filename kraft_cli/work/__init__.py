"""What each command does, from its options to its table and JSON; loaded when the command runs."""
