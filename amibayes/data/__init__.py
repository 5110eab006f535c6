"""Observables and their covariance."""
