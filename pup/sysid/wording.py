"""What the report of pre-sysID says in words."""

from collections import Counter
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pup.physics.parameters import ParameterSpace
from pup.recording import Recording
from pup.sysid.bounds import SPLIT_LEVEL
from pup.sysid.result import Bounds

Array = NDArray[np.float64]

STRONG = 0.9
"""Estimates correlated more than this are named as one quantity seen twice."""
UNMOVED = 0.02
"""A subset's fit this near to the nominal value, in search ranges, did not move the parameter."""
_PLACES = {"suspended": "suspended", "ground": "on the ground", "bench": "on a bench"}


def listed(names: Sequence[str]) -> str:
    """`a`, `a and b`, `a, b and c`."""
    if len(names) < 2:
        return "".join(names)
    return f"{', '.join(names[:-1])} and {names[-1]}"


def counted(count: int, noun: str) -> str:
    """`1 fit`, `2 fits`."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def number(value: float) -> str:
    """Four significant digits."""
    return f"{value:.4g}"


def thousandths(value: float) -> str:
    """An error in thousandths, to a tenth or, where that says nothing, two digits."""
    small = 1000 * value
    return f"{small:.1f}" if small >= 1 else f"{small:.2g}"


def p_value(value: float) -> str:
    """A p-value, or that there is none."""
    if np.isnan(value):
        return "not tested"
    return f"{value:.4f}"


def recordings_words(recordings: Sequence[Recording]) -> str:
    """How many recordings there are, and how many of each support."""
    supports = Counter(r.support for r in recordings)
    parts = [f"{n} {_PLACES[s]}" for s, n in sorted(supports.items(), reverse=True)]
    return f"{counted(len(recordings), 'recording')} ({', '.join(parts)})"


def unidentified(bounds: Bounds) -> list[str]:
    """Names of the parameters that the recordings do not determine."""
    return [n for n, known in zip(bounds.space.names, bounds.identified, strict=True) if not known]


def splitting(bounds: Bounds) -> list[str]:
    """Names of the parameters that split between subsets with and without contact.

    Those that one side does not see are not among them: see `blind`.
    """
    unseen = blind(bounds)
    return [split.name for split in bounds.splits if split.split and split.name not in unseen]


def blind(bounds: Bounds) -> dict[str, str]:
    """Parameters that differ because one side leaves them where the subset fits start and end.

    A subset's fit is pulled to the nominal point, so recordings that say nothing of a parameter
    return its nominal value; that is no second value.

    Returns:
      Name to the side that does not see it, `with` or `without`.
    """
    found = {}
    nominal = bounds.space.normalise(bounds.nominal)
    for split in bounds.splits:
        at = bounds.space.names.index(split.name)
        width = bounds.space.upper[at] - bounds.space.lower[at]
        for side, values in (("without", split.without), ("with", split.with_contact)):
            unit = (values - bounds.space.lower[at]) / width
            if split.split and np.abs(unit - nominal[at]).max(initial=0.0) < UNMOVED:
                found[split.name] = side
    return found


def tested(bounds: Bounds) -> bool:
    """Whether the test for a split could be made."""
    return any(not np.isnan(split.p_value) for split in bounds.splits)


def why_untested(bounds: Bounds, recordings: Sequence[Recording]) -> str:
    """Why there is no test for a split."""
    contact = [s.contact for s in bounds.subsets]
    if not contact:
        return "no fits to subsets of the recordings were made"
    if not any(r.support == "ground" for r in recordings):
        return "no recording is on the ground"
    if all(r.support == "ground" for r in recordings):
        return "every recording is on the ground"
    few = min((contact.count(True), "with"), (contact.count(False), "without"))
    if few[0] >= 2:
        return "the subset fits were not compared"
    return (
        f"of the {len(contact)} subset fits {few[0] or 'none'} is {few[1]} ground contact, "
        "and two on each side are needed"
    )


def split_words(bounds: Bounds, recordings: Sequence[Recording]) -> str:
    """What came of the test for a split, in one sentence."""
    if not tested(bounds):
        return f"Could not be tested because {why_untested(bounds, recordings)}."
    p_values = {split.name: p_value(split.p_value) for split in bounds.splits}
    found = [f"{name} (p = {p_values[name]})" for name in splitting(bounds)]
    if not found:
        return "No split found between subset fits with and without ground contact."
    takes = "takes" if len(found) == 1 else "take"
    return f"{listed(found)} {takes} other values with ground contact than without."


def split_meaning(bounds: Bounds) -> list[str]:
    """What the result of the test means, a paragraph each."""
    found, unseen, vague = splitting(bounds), blind(bounds), unidentified(bounds)
    p_values = {split.name: p_value(split.p_value) for split in bounds.splits}
    paragraphs = []
    if found:
        plural = len(found) > 1
        paragraphs.append(
            f"No single value of {listed(found)} explains both kinds of recordings: the model "
            "lacks something that acts differently under contact. In the paper the torque limit "
            "was bipolar in this way. The bounds cover both values, so a policy trained on them "
            "copes with either, but the missing physics is still missing; pup diagnose looks "
            "for it."
        )
        doubtful = [name for name in found if name in vague]
        if doubtful:
            paragraphs.append(
                f"Caution: all the recordings together do not identify {listed(doubtful)}, so "
                f"{'these splits' if plural else 'this split'} may show which recordings see the "
                "parameter at all rather than two values of it."
            )
    elif tested(bounds):
        paragraphs.append(
            "One value of each parameter serves both kinds of recordings as far as these fits "
            "can tell. With few subsets on either side only large differences would show."
        )
    paragraphs += [
        f"The values of {name} differ too (p = {p_values[name]}), but the subsets {side} contact "
        "left it at its nominal value: they do not see it, so this is no second value."
        for name, side in unseen.items()
    ]
    other = [n for n in two_clusters(bounds) if n not in found and n not in unseen]
    if other:
        paragraphs.append(
            f"Without regard to contact, the values of {listed(other)} fall into two clusters: "
            "something other than contact separates the subsets, such as single recordings."
        )
    return paragraphs


def two_clusters(bounds: Bounds) -> list[str]:
    """Parameters whose values fall into two clusters, corrected for the number looked at."""
    level = SPLIT_LEVEL / max(1, len(bounds.splits))
    return [split.name for split in bounds.splits if split.two_clusters < level]


def strong_pairs(bounds: Bounds) -> list[str]:
    """Pairs of parameters that the recordings hardly tell apart, strongest first."""
    names, matrix = bounds.space.names, bounds.correlation
    rows, columns = np.triu_indices(len(names), k=1)
    pairs = sorted(zip(rows, columns, strict=True), key=lambda at: -abs(matrix[at]))
    return [
        f"{names[i]} and {names[j]} (r = {matrix[i, j]:+.2f}): "
        + (
            "raising both together changes the motion little"
            if matrix[i, j] > 0
            else "raising one and lowering the other changes the motion little"
        )
        for i, j in pairs
        if abs(matrix[i, j]) > STRONG
    ]


def interval(bounds: Bounds, i: int) -> str:
    """The 90 % interval of a parameter's fit; of one that was kept there is none."""
    low, high = bounds.ci90[i]
    return "kept" if low == high else f"{number(low)} to {number(high)}"


def imu_words(bounds: Bounds) -> str:
    """How the IMU was found to sit, and how late it tells."""
    told = zip(bounds.imu.names, bounds.imu.units, bounds.imu.nominal, strict=True)
    plain = str.maketrans({"_": " ", "/": " in "})
    return listed(
        [
            f"{name.partition('@')[0].translate(plain)} {1e3 * value:.1f} m{unit}"
            for name, unit, value in told
        ]
    )


def untold(space: ParameterSpace, few: NDArray[np.bool_], kept: Collection[str]) -> list[str]:
    """Which parameters have no range of subset fits, and what their bounds are then.

    Args:
      space: the bounded parameters.
      few: whether fewer than two subsets see each, shape (n_parameters,).
      kept: those whose values were kept as described.
    """
    names = [name for name, so in zip(space.names, few, strict=True) if so]
    seen = {
        "bounds hold the whole interval by all recordings": [n for n in names if n not in kept],
        "kept as described; bounds do not tell how far off": [n for n in names if n in kept],
    }
    return [f"fewer than two subsets see {listed(n)}: {so}" for so, n in seen.items() if n]


def flattened(value: Any, name: str = "") -> list[tuple[str, str]]:
    """A JSON value as rows of name and text; nested names are joined by dots."""
    if isinstance(value, dict):
        items = [(f"{name}.{key}" if name else str(key), inner) for key, inner in value.items()]
        return [row for key, inner in items for row in flattened(inner, key)]
    if isinstance(value, list | tuple):
        if any(isinstance(inner, dict | list | tuple) for inner in value):
            return [row for i, inner in enumerate(value) for row in flattened(inner, f"{name}.{i}")]
        return [(name, ", ".join(map(_plain, value)))]
    return [(name, _plain(value))]


def _plain(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return str(value)


def with_unit(name: str, space: ParameterSpace) -> str:
    """A parameter's name, with its unit where it has one."""
    unit = space.units[space.names.index(name)]
    return name if unit == "1" else f"{name} [{unit}]"


def spread(values: Array) -> str:
    """Mean and standard deviation."""
    return f"{values.mean():.3g} ± {values.std():.2g}" if len(values) else "none"


def error(value: float, diverged: bool) -> str:
    """An RMSE in thousandths, and whether the simulation broke down."""
    return thousandths(value) + (" (broke down)" if diverged else "")


def extremes(joints: Sequence[str], errors: Array) -> str:
    """Smallest and largest error with their joints."""
    low, high = int(np.argmin(errors)), int(np.argmax(errors))
    least, most = thousandths(errors[low]), thousandths(errors[high])
    return f"from {least} ({joints[low]}) to {most} ({joints[high]})"


def setup(recording: Recording) -> str:
    """The knobs set in a recording."""
    return ", ".join(f"{knob} {value:g}" for knob, value in recording.setup.items())
