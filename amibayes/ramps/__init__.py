"""Ramps: charge that passes between pixels, measured and taken out."""
