"""Post-sysID: which eta walks furthest on the robot, found in few trials (paper, section V)."""
