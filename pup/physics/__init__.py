"""Many simulations of one robot under many candidate parameters."""
