"""Files, options and messages that every package uses."""
