"""A robot that is not there: Dynamixel servos, board and IMU on pseudo-terminals, moved by MuJoCo.

Its physics is its own and concealed: nothing here is shared with the simulators of `pup`, so that
what carries over to it may carry over to a real robot too.
"""
