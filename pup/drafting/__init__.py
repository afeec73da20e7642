"""A robot's folder drafted from the model that a laboratory has already."""
