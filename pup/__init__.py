"""pup: from a simulator that is wrong to a robot that walks."""
