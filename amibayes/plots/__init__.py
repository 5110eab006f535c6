"""Pictures: one small module for each, every function takes containers and returns a Figure."""
