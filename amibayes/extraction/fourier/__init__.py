"""Extraction in the Fourier plane."""
