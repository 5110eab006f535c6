"""Contrasts at which a companion would have been found."""
