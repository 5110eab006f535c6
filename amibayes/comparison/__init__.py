"""Models of the sky compared: companion, disc, ring and crescent, with measured error rates."""
