"""Bounds that parameters are drawn from."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from walking import BOUNDS, DARWIN, walking

from pup.errors import InputError
from pup.locomotion.sampling import MARGIN, ParameterSampler
from pup.locomotion.settings import TaskSettings
from pup.sysid.result import read_bounds


def changed(folder: Path, **entry: Any) -> Path:
    """The robot's own bounds with the first parameter changed; None leaves a key out."""
    document = json.loads(DARWIN.identified_path.read_text())
    first = document["parameters"][0] | entry
    document["parameters"][0] = {key: value for key, value in first.items() if value is not None}
    path = folder / "bounds.json"
    path.write_text(json.dumps(document))
    return path


def test_bounds_are_read_around_the_fitted_values() -> None:
    document = json.loads(DARWIN.identified_path.read_text())
    assert BOUNDS.names == tuple(entry["name"] for entry in document["parameters"])
    assert len(BOUNDS.names) == 14 and BOUNDS.actuator == "nn_pd"
    np.testing.assert_array_equal(BOUNDS.lower, [e["lower"] for e in document["parameters"]])
    nominal = [BOUNDS.space.nominal[BOUNDS.space.names.index(name)] for name in BOUNDS.names]
    np.testing.assert_array_equal(nominal, [e["nominal"] for e in document["parameters"]])


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({"lower": None}, "parameter 'rho/arm' has no bounds lower and upper"),
        ({"upper": "high"}, "parameter 'rho/arm' has no bounds lower and upper"),
        ({"lower": 2.0, "upper": 1.0}, "parameter 'rho/arm': [2, 1] are no bounds"),
        ({"lower": 1.0, "upper": float("inf")}, "parameter 'rho/arm': [1, inf] are no bounds"),
        ({"name": "rho/tail"}, "parameter 'rho/tail' is not one of robot 'darwin_op2'"),
        ({"name": "rho/head"}, "parameter 'rho/head' stands there more than once"),
        ({"lower": -5.0, "upper": -4.0}, "'rho/arm': bounds [-5, -4] outside its search range 0"),
        ({"lower": 50.0, "upper": 60.0}, "'rho/arm': bounds [50, 60] outside its search range 0"),
        ({"nominal": -1.0}, "parameter 'rho/arm': nominal -1 outside its search range 0 to 3"),
    ],
)
def test_wrong_bounds_are_refused(tmp_path: Path, entry: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError) as refused:
        read_bounds(changed(tmp_path, **entry), DARWIN)
    assert words in str(refused.value) and "\n" not in str(refused.value)


@given(arrays(np.float64, (5, 14), elements=st.floats(-0.5, 1.5)), st.sets(st.integers(0, 13)))
def test_the_unit_scale_has_an_inverse_also_where_bounds_are_one(
    unit: np.ndarray, pinned: set[int]
) -> None:
    upper = BOUNDS.upper.copy()
    upper[list(pinned)] = BOUNDS.lower[list(pinned)]
    sampler = ParameterSampler(replace(BOUNDS, upper=upper))
    np.testing.assert_allclose(sampler.unit(sampler.physical(unit)), unit, atol=1e-12)


def test_what_policies_are_told_in_trainings_spans_the_box_of_eta() -> None:
    """Of a parameter whose bounds are one that is the error alone; of others all their bounds."""
    upper = BOUNDS.upper.copy()
    upper[3] = BOUNDS.lower[3]
    noise = TaskSettings().parameter_noise
    for bounds in (BOUNDS, replace(BOUNDS, upper=upper)):
        sampler = ParameterSampler(bounds)
        spanned = sampler.told(np.random.default_rng(0), 1000, noise)
        heard = walking(TaskSettings(), 1000, sampler=sampler)
        heard.reset()
        told = heard.state()["episodes/told"]
        np.testing.assert_allclose(spanned.min(axis=0), told.min(axis=0), atol=0.02)
        np.testing.assert_allclose(spanned.max(axis=0), told.max(axis=0), atol=0.02)
        every = np.random.default_rng(0).uniform(-MARGIN, 1 + MARGIN, spanned.shape)
        same = bounds.upper > bounds.lower
        np.testing.assert_array_equal(spanned[:, same], every[:, same])


def test_a_parameter_whose_bounds_are_one_has_that_value_in_every_episode() -> None:
    """Unless it is given another, which it then has."""
    pinned = [BOUNDS.names.index(name) for name in ("rho/arm", "ground_friction")]
    lower, upper = BOUNDS.lower.copy(), BOUNDS.upper.copy()
    lower[pinned] = upper[pinned] = (BOUNDS.lower + BOUNDS.upper)[pinned] / 2
    bounds = replace(BOUNDS, lower=lower, upper=upper)
    sampler = ParameterSampler(bounds)
    mu = sampler.draw(np.random.default_rng(0), np.arange(200))
    assert (mu[:, pinned] == 0).all() and (np.ptp(mu, axis=0) > 0).sum() == 12
    for values in (sampler.candidates(mu), sampler.largest()):
        held = values.columns(bounds.names)[:, pinned]
        np.testing.assert_array_equal(held, np.broadcast_to(lower[pinned], held.shape))
    nominal = ParameterSampler.nominal(bounds)
    values = nominal.candidates(nominal.draw(np.random.default_rng(0), np.arange(1)))
    np.testing.assert_allclose(values.values[0], bounds.space.nominal, rtol=1e-12)
