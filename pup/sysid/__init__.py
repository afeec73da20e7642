"""Identification of model parameters from recordings."""
