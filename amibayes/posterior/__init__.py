"""What the data say of the parameters: priors, grids, chains, evidence."""
