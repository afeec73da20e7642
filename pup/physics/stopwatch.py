"""MuJoCo's stopwatch, put away.

MuJoCo times the stages of each step where it is given a clock, and its Python bindings give it one.
Nobody here asks for these times, and reading the clock takes 40 % of a step of one joint, 10 to
20 % of one of 20. The bindings' `set_mjcb_time` can give another clock, but none at all only the
library itself can have.
"""

import ctypes
from pathlib import Path

import mujoco

CLOCK = "mjcb_time"
"""The library's global pointer to a clock (mujoco.h, "callbacks")."""


def put_away() -> None:
    """Let steps go untimed in this process, wherever the library lies where wheels put it."""
    for path in Path(mujoco.__file__).parent.glob("*mujoco.*"):
        if path.suffix in {".dll", ".dylib"} or ".so." in path.name:
            ctypes.c_void_p.in_dll(ctypes.CDLL(str(path)), CLOCK).value = None
