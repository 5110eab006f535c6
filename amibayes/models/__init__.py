"""Source models: what the sky may be, and its parameters."""
