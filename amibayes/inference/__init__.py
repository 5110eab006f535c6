"""Model, likelihood, search and posterior of companions."""
