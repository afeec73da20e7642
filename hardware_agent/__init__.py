"""The robot side."""
