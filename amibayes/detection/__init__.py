"""How often noise alone gives what was found."""
