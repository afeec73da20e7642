"""pup on Ray."""
