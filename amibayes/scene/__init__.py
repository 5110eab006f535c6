"""What is observed in a simulation: sources, spectra, orientation."""
