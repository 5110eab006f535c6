"""The search of the whole field for a companion."""
