"""Algorithm 1 of the paper: ranges of parameters from fits to random subsets of recordings."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pup.physics.parameters import ParameterSpace

Array = NDArray[np.float64]

EXPANSION = 0.1
"""The range grows by this share of its width at both ends (paper, Algorithm 1)."""
WIDENING = 0.05
"""Share of the search range by which an interval of the fit may widen a range, at each end."""
PERMUTATIONS = 10_000
SPLIT_LEVEL = 0.05


def draw_subsets(count: int, subsets: int, fraction: float, seed: int) -> list[tuple[int, ...]]:
    """Random subsets of recordings, drawn without replacement within each.

    Algorithm 1 of the paper draws each subset anew, so that a tenth of the recordings may miss some
    in all of its subsets, and with them the only ones that show a parameter. Here subsets are dealt
    from the shuffled recordings, which are shuffled again when all are dealt: each comes up once
    before any comes up twice, as far as the number of subsets goes.

    Args:
      count: number of recordings.
      subsets: how many subsets.
      fraction: share of the recordings in each; at least two are drawn.
      seed: of the draw.
    """
    rng = np.random.default_rng(seed)
    size = min(count, max(2, round(count * fraction)))
    drawn, deck = [], list[int]()
    for _ in range(subsets):
        subset, deck = deck[:size], deck[size:]
        if short := size - len(subset):
            fresh = list(map(int, rng.permutation(count)))
            more = [i for i in fresh if i not in subset][:short]
            subset, deck = subset + more, [i for i in fresh if i not in more]
        drawn.append(tuple(sorted(subset)))
    return drawn


def expanded_range(fits: Array, space: ParameterSpace) -> tuple[Array, Array]:
    """Per-parameter range of the subset fits, expanded by 10 % and kept in the search range.

    Args:
      fits: physical values, shape (n_subsets, n_parameters); NaN where a subset cannot see a
        parameter, but each has at least one value.
      space: their space.

    Returns:
      Lower and upper bounds, shape (n_parameters,) each.
    """
    low, high = np.nanmin(fits, axis=0), np.nanmax(fits, axis=0)
    margin = EXPANSION * (high - low)
    return np.maximum(low - margin, space.lower), np.minimum(high + margin, space.upper)


def widened(
    low: Array,
    high: Array,
    interval: tuple[Array, Array],
    space: ParameterSpace,
    share: Array | float = WIDENING,
) -> tuple[Array, Array]:
    """A range that holds an interval, as far as that is little wider.

    A few subsets, all pulled to the nominal point, may differ by less than the recordings leave
    open. Where they contradict the model, though, an interval covers nearly everything, and a
    policy that is trained for everything walks nowhere.

    Args:
      low: lower bounds, shape (n_parameters,).
      high: upper bounds.
      interval: its ends, likewise.
      space: of the parameters.
      share: of their search ranges, by which each end moves at most; 1 where there is no range that
        an interval could contradict.
    """
    most = share * (space.upper - space.lower)
    return (
        np.minimum(low, np.maximum(interval[0], low - most)),
        np.maximum(high, np.minimum(interval[1], high + most)),
    )


@dataclass(frozen=True)
class Split:
    """Whether a parameter takes other values where subsets contain contact.

    Attributes:
      name: the parameter.
      with_contact: its values in the subsets with contact, physical.
      without: its values in those without.
      separation: difference of the two means over its standard error.
      p_value: of the difference, by permuting which recordings touch the ground and corrected for
        the number of parameters looked at (family-wise, largest statistic); NaN when a side has
        under two fits.
      two_clusters: p-value of the values being one cluster against two, labels unseen.
    """

    name: str
    with_contact: Array
    without: Array
    separation: float
    p_value: float
    two_clusters: float

    @property
    def split(self) -> bool:
        """Whether the difference is significant."""
        return bool(self.p_value < SPLIT_LEVEL)


def contact_splits(
    fits: Array,
    space: ParameterSpace,
    subsets: Sequence[Sequence[int]],
    ground: Sequence[bool],
    seed: int = 0,
) -> list[Split]:
    """Test each parameter for a split between subsets with and without contact.

    The paper saw one in the torque limit and took it for a sign of missing physics (section V-E).
    Subsets share recordings, so their fits are not independent; what is exchangeable without an
    effect of contact is which recordings are those on the ground, and that is what is permuted.

    Args:
      fits: physical values, shape (n_subsets, n_parameters); NaN where a subset cannot see a
        parameter.
      space: their space.
      subsets: the recordings of each subset, by index.
      ground: whether each recording is on the ground.
      seed: of the permutations.
    """
    unit = space.normalise(fits)
    touching = np.asarray(ground, dtype=bool)
    member = np.array([np.isin(np.arange(len(touching)), subset) for subset in subsets])
    label = _contact(member, touching)
    rng = np.random.default_rng(seed)
    seen = ~np.isnan(unit)
    testable = (seen[label].sum(axis=0) >= 2) & (seen[~label].sum(axis=0) >= 2)
    observed, p_values = np.full((2, len(space)), np.nan)
    if testable.any():
        tested = unit[:, testable]
        observed[testable] = _separation(tested, label)
        shuffled = (_contact(member, rng.permutation(touching)) for _ in range(PERMUTATIONS))
        largest = np.array([np.abs(_separation(tested, s)).max(initial=0) for s in shuffled])
        beyond = largest[:, None] >= np.abs(observed[testable]) - 1e-12
        p_values[testable] = (1 + beyond.sum(axis=0)) / (1 + PERMUTATIONS)
    return [
        Split(
            name,
            fits[label & seen[:, i], i],
            fits[~label & seen[:, i], i],
            float(observed[i]),
            float(p_values[i]),
            two_cluster_p(unit[seen[:, i], i], rng),
        )
        for i, name in enumerate(space.names)
    ]


def _contact(member: NDArray[np.bool_], ground: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which subsets (rows of `member`) contain a recording on the ground."""
    return np.asarray((member & ground).any(axis=1))


def _separation(unit: Array, label: NDArray[np.bool_]) -> Array:
    """Difference of the two means over its standard error (Welch), per parameter.

    0 where a side has fewer than two values.
    """
    values = np.where(np.isnan(unit), 0.0, unit)
    known = ~np.isnan(unit)
    sides = []
    for side in (label, ~label):
        n = known[side].sum(axis=0)
        mean = values[side].sum(axis=0) / np.maximum(n, 1)
        squares = (known[side] * (values[side] - mean) ** 2).sum(axis=0)
        sides.append((n, mean, squares / np.maximum(n * (n - 1), 1)))
    (n_a, a, error_a), (n_b, b, error_b) = sides
    separation = (a - b) / np.maximum(np.sqrt(error_a + error_b), 1e-3)
    return np.where((n_a >= 2) & (n_b >= 2), separation, 0.0)


def two_cluster_p(values: Array, rng: np.random.Generator, draws: int = 2000) -> float:
    """P-value of one cluster against two, labels unseen.

    The statistic is the share of the variance that the best split in two leaves; its null is a
    normal sample of the same size (a uniform or normal cloud is one cluster).

    Args:
      values: shape (n,).
      rng: for the null's draws.
      draws: how many.
    """
    if len(values) < 4 or np.ptp(values) < 1e-9:
        return 1.0
    null = np.array([_left_by_two(sample) for sample in rng.normal(size=(draws, len(values)))])
    return float((1 + (null <= _left_by_two(values)).sum()) / (1 + draws))


def _left_by_two(values: Array) -> float:
    """Within-cluster share of the variance under the best split of sorted values in two."""
    x = np.sort(values)
    n = np.arange(1, len(x))
    left, total = np.cumsum(x)[:-1], x.sum()
    between = left**2 / n + (total - left) ** 2 / (len(x) - n) - total**2 / len(x)
    return float(1 - between.max() / max(((x - x.mean()) ** 2).sum(), 1e-300))
