"""Policies: their networks, their symmetry, and the bundle that a robot's computer runs."""
