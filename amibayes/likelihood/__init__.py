"""The likelihood of data given a source model, and the noise models."""
