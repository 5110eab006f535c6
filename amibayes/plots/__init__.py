"""Pictures: one small module for each, matplotlib figures out, nothing global."""
