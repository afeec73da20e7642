"""Rivals of the diagnosis on concealed cases; see `benchmarks.blind_rivals`."""
