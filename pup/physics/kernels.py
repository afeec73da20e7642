"""The arithmetic of a sub-step, compiled.

A call of NumPy costs more than all arithmetic of a few simulations; each function here does in one
loop over simulations and joints what would take tens of calls.

Arrays have a row for each simulation and a column for each joint; those of timesteps have one
column. The first simulations are active, as many as the motion or else the torque has rows: other
arrays may have more, which are left alone. What is computed for a simulation depends on its
own row only.
"""

import functools
import hashlib
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, get_type_hints

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Index = NDArray[np.int64]
Ids = NDArray[np.int32]
P = ParamSpec("P")
R = TypeVar("R")

ARRAY, MASK, INDEX = numba.float64[:, :], numba.boolean[:, :], numba.int64[:, :]
IDS = numba.int32[:]
_TYPES = {Array: ARRAY, Mask: MASK, Index: INDEX, Ids: IDS, float: numba.float64}
"""Strides of any kind, so that a function is compiled once whatever arrays are views of."""


def digest(*modules: str | None) -> str:
    """What the sources of some modules, by their files, come to."""
    sources = b"".join(Path(str(module)).read_bytes() for module in modules)
    return hashlib.sha256(sources).hexdigest()[:16]


_OWN = digest(__file__)


def _compile(make: Callable[..., Any], function: Callable[..., Any], *types: object) -> Any:
    """Compile, and keep the outcome for the next process where some folder can be written."""
    try:
        return make(*types, cache=True)(function)
    except (RuntimeError, OSError, EOFError):  # there is none, it is full, or was cut short
        return make(*types)(function)


def kernel(function: Callable[P, None]) -> Callable[P, None]:
    """Compile a function for the types that it names; divisions by zero are as in NumPy.

    It may call what is compiled in this module, and in its own.
    """
    hints = get_type_hints(function)
    names = function.__code__.co_varnames[: function.__code__.co_argcount]
    signature = numba.void(*(_TYPES[hints[name]] for name in names))
    compiled: Callable[P, None] = assembled(function, signature, _OWN)
    return compiled


def part(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function that only compiled ones call, for the types that they call it with."""
    make = numba.njit(nogil=True, error_model="numpy", inline="always")
    compiled: Callable[P, R] = make(function)
    return compiled


def assembled(function: Callable[P, R], signature: object, made_of: str) -> Callable[P, R]:
    """Compile a function that calls compiled ones of other modules.

    Args:
      function: what to compile.
      signature: its types.
      made_of: digest of these modules. Numba holds what it has kept against the function's own file
        alone, so the name by which it is kept tells of the others.
    """
    function.__qualname__ = f"{function.__name__}_{made_of}"
    make = functools.partial(numba.njit, nogil=True, error_model="numpy")
    compiled: Callable[P, R] = _compile(make, function, signature)
    return compiled


def _implicit_share(damping: float, inertia: float, timestep: float) -> float:
    x = max(damping * (timestep / inertia), 1e-6)
    return -1 / math.expm1(-x) - 1 / x


implicit_share: np.ufunc = _compile(numba.vectorize, _implicit_share, ["f8(f8, f8, f8)"])
"""See `implicit.implicit_share`; of numbers, in the functions below, and of arrays."""


@kernel
def limit(
    torque: Array,
    damping: Array,
    velocity: Array,
    upper: Array,
    lower: Array,
    slope: Array,
    before: Array,
    acted: Array,
    damped: Array,
    share: Array,
    inertia: Array,
) -> None:
    """Keep servos within their limits; what falls with speed at a limit damps there.

    Whether a servo is at its limit is decided by the velocity that its damping meets in the
    sub-step, by each joint's own inertia and the torque from outside that the last one showed.
    Decided by the velocity that is, a servo would leave its limit with a jump of its torque, by
    what a sub-step changes of the damping, and trajectories would jump with whatever moves that
    moment past a sub-step's end. Stiff damping brakes within the sub-step: velocities that only go
    on as they did would mislead.

    Args:
      torque: of the law, N m; changed in place.
      damping: its viscous coefficient, N m s/rad; changed in place.
      velocity: rad/s.
      upper: largest torque, N m.
      lower: smallest one, N m.
      slope: by how much both fall with the velocity at the sub-step's end, N m s/rad.
      before: velocity at the last sub-step, rad/s.
      acted: torque over it, N m; NaN where there was none yet.
      damped: viscous coefficient over it, N m s/rad.
      share: of the law's damping that a sub-step takes implicitly.
      inertia: what a joint's torque accelerates, over the timestep, kg m²/s.
    """
    for i in range(velocity.shape[0]):
        for j in range(velocity.shape[1]):
            now, reach = velocity[i, j], share[i, j] / inertia[i, j]
            gained = now - before[i, j]
            met = gained * share[i, j] + before[i, j]  # by what was taken implicitly
            outside = gained * inertia[i, j] + damped[i, j] * met - acted[i, j]
            ahead = ((torque[i, j] + outside) * reach + now) / (reach * damping[i, j] + 1)
            if math.isnan(ahead):  # it starts: nothing is known of what is to come
                ahead = now
            total = torque[i, j] - damping[i, j] * ahead
            if not total < upper[i, j]:
                torque[i, j] = upper[i, j] + slope[i, j] * now
                damping[i, j] = slope[i, j]
            if not total > lower[i, j]:
                torque[i, j] = lower[i, j] + slope[i, j] * now
                damping[i, j] = slope[i, j]


@kernel
def blend(
    error: Array,
    torque: Array,
    damping: Array,
    old_error: Array,
    old_torque: Array,
    old_damping: Array,
    share: Array,
) -> None:
    """Let what a command asks for hold for a share of a sub-step, and what the old one did before.

    Args:
      error: rad; changed in place.
      torque: N m; changed in place.
      damping: N m s/rad; changed in place.
      old_error: by the old command, rad.
      old_torque: by it, N m.
      old_damping: by it, N m s/rad.
      share: of the sub-step.
    """
    for i in range(error.shape[0]):
        for j in range(error.shape[1]):
            now, then = share[i, j], 1 - share[i, j]
            error[i, j] = now * error[i, j] + then * old_error[i, j]
            torque[i, j] = now * torque[i, j] + then * old_torque[i, j]
            damping[i, j] = now * damping[i, j] + then * old_damping[i, j]


@kernel
def split(
    torque: Array,
    damping: Array,
    brake: Array,
    viscous: Array,
    velocity: Array,
    free: Array,
    free_share: Array,
    held: Array,
    held_share: Array,
    inertia: Array,
    timestep: Array,
) -> None:
    """Apply as it is what of a torque by damping a sub-step does not take implicitly.

    Args:
      torque: of the servos, N m; changed in place.
      damping: of the servos, N m s/rad; to what is taken implicitly, in place.
      brake: torque against the servos' by damping outside them, N m; written.
      viscous: damping outside the servos, N m s/rad; to what is taken implicitly, in place.
      velocity: rad/s.
      free: all damping where a servo is off its limit, N m s/rad.
      free_share: of it, to be taken implicitly.
      held: all damping where a servo is at its limit, N m s/rad.
      held_share: of it, to be taken implicitly.
      inertia: what a joint's torque accelerates, kg m².
      timestep: s.
    """
    for i in range(velocity.shape[0]):
        for j in range(velocity.shape[1]):
            total = damping[i, j] + viscous[i, j]
            if total == free[i, j]:  # as it mostly is, or the next, without exponentials
                share = free_share[i, j]
            elif total == held[i, j]:
                share = held_share[i, j]
            else:
                share = implicit_share(total, inertia[i, j], timestep[i, 0])
            rest = (1 - share) * velocity[i, j]
            torque[i, j] -= rest * damping[i, j]
            damping[i, j] *= share
            brake[i, j] = rest * viscous[i, j]
            viscous[i, j] *= share


@kernel
def look_up(
    now: Array,
    before: Array,
    share: Array,
    start: Array,
    end: Array,
    commands: Array,
    times: Array,
    newest: Index,
    timestep: float,
) -> None:
    """What commands are held between two times; a row is a recording here.

    Args:
      now: what is at the end, rad, (n_recordings, n_candidates * n_joints); written.
      before: what was until the last change, on the average; written.
      share: of the time for which `now` has been held; written.
      start: of the time, s; as many columns as `now`, or one for all joints of a candidate.
      end: s; the same, a timestep later.
      commands: of all recordings, one after the other, (n_recordings * n_commands, n_joints), rad.
      times: since when they hold, (n_recordings, n_commands), s; infinite behind the last.
      newest: which was the newest at each sub-step, (n_recordings, n_steps).
      timestep: s.
    """
    joints, last = commands.shape[1], newest.shape[1] - 1
    width = now.shape[1] // end.shape[1]
    for i in range(end.shape[0]):
        for k in range(end.shape[1]):
            row = newest[i, min(max(int(end[i, k] / timestep), 0), last)]
            while times[i, row + 1] <= end[i, k]:
                row += 1
            first = row
            while first > 0 and times[i, first] > start[i, k]:
                first -= 1
            since = min(max((end[i, k] - times[i, row]) / timestep, 0.0), 1.0)
            own = i * times.shape[1]
            for c in range(k * width, (k + 1) * width):
                told, then = commands[own + row, c % joints], commands[own + first, c % joints]
                if row - first > 1:
                    more = (then - told) * (times[i, first + 1] - start[i, k])
                    for r in range(first + 1, row):
                        off = commands[own + r, c % joints] - told
                        more += off * (times[i, r + 1] - times[i, r])
                    then = told + more / (times[i, row] - start[i, k])
                now[i, c], before[i, c] = told, then
                share[i, c] = 1.0 if told == then else since
