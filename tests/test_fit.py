"""CMA-ES fits: the first step, convergence, checkpoints, the pull to the nominal point."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pup.errors import InputError
from pup.sysid import fit
from pup.sysid.fit import W_REG, CmaFit, FitResult, FitSettings, run_fit

SPHERE = FitSettings(np.full(5, 0.4), population=8, generations=12, seed=3)


def sphere(unit: np.ndarray) -> np.ndarray:
    return ((unit - 0.7) ** 2).sum(axis=1)


def ellipsoid(dimension: int, condition: float) -> tuple[np.ndarray, np.ndarray]:
    """A rotated quadratic's matrix and its minimum, inside the cube."""
    rng = np.random.default_rng(1)
    rotation = np.linalg.qr(rng.normal(size=(dimension, dimension)))[0]
    scales = condition ** np.linspace(0, 1, dimension)
    return rotation * scales @ rotation.T, rng.uniform(0.3, 0.7, dimension)


def same(a: FitResult, b: FitResult) -> bool:
    return (
        a.loss == b.loss and np.array_equal(a.best, b.best) and np.array_equal(a.history, b.history)
    )


@pytest.mark.parametrize("dimension", [1, 14, 41])
@pytest.mark.parametrize("sigma", [0.05, 0.25])
def test_first_population_spreads_by_sigma(dimension: int, sigma: float) -> None:
    """Nevergrad's own scale would be several times too timid, and jumps at 18 dimensions."""
    fit = CmaFit(FitSettings(np.full(dimension, 0.5), sigma, population=2000))
    first = fit.ask()
    assert ((first >= 0) & (first <= 1)).all()
    folded = np.random.default_rng(0).normal(0.5, sigma, 100_000)
    folded = 1 - np.abs(1 - np.abs(folded))  # the walls fold it back: 0.25 leaves 0.232
    assert first.std(axis=0).mean() == pytest.approx(folded.std(), rel=0.03)
    assert np.abs(first.mean(axis=0) - 0.5).max() < 0.03


def test_a_start_on_the_wall_is_searched_from() -> None:
    fit = CmaFit(FitSettings(np.array([0.0, 1.0, 0.5]), 0.05, population=200))
    first = fit.ask()
    assert np.isfinite(first).all()
    assert (np.abs(first.mean(axis=0) - [0.0, 1.0, 0.5]) < 0.06).all()


@pytest.mark.parametrize(("dimension", "generations"), [(14, 150), (41, 250)])
def test_converges_on_a_rotated_ellipsoid(dimension: int, generations: int) -> None:
    matrix, minimum = ellipsoid(dimension, 100.0)

    def evaluate(unit: np.ndarray) -> np.ndarray:
        return np.einsum("ni,ij,nj->n", unit - minimum, matrix, unit - minimum)

    start = np.full(dimension, 0.5)
    found = run_fit(FitSettings(start, population=16, generations=generations, seed=2), evaluate)
    print(found.loss / evaluate(start[None])[0], np.abs(found.best - minimum).max())


def test_keeps_its_own_best() -> None:
    """Nevergrad's recommendation can lose it: the result is the best of all candidates seen."""
    rng = np.random.default_rng(0)
    seen: list[tuple[float, np.ndarray]] = []

    def noisy(unit: np.ndarray) -> np.ndarray:
        losses = rng.lognormal(0, 2, len(unit))
        seen.extend(zip(losses, unit.copy(), strict=True))
        return losses

    found = run_fit(SPHERE, noisy)
    loss, best = min(seen, key=lambda s: s[0])
    assert found.loss == loss
    assert np.array_equal(found.best, best)
    assert (np.diff(found.history) <= 0).all()
    assert len(found.history) == SPHERE.generations


def test_is_never_worse_than_its_start() -> None:
    """The first mean is no candidate of the search, but it counts."""
    narrow = FitSettings(np.full(3, 0.7), population=4, generations=1)
    found = run_fit(narrow, sphere)
    assert found.loss == 0
    assert np.array_equal(found.best, narrow.start)


def test_flat_objective_does_not_restart_the_search() -> None:
    """Pycma would stop on a flat objective and begin again elsewhere."""
    fit = CmaFit(FitSettings(np.full(4, 0.5), 0.1, population=8))
    for _ in range(40):
        fit.ask()
        fit.tell(np.ones(8))
    assert np.isfinite(fit.ask()).all()
    inner = fit._optimizer._es
    assert inner.countiter == 40


@settings(max_examples=15)
@given(st.integers(1, SPHERE.generations), st.booleans())
def test_resumes_to_the_last_bit(tmp_path_factory: pytest.TempPathFactory, at: int, again: bool):
    """Interrupted after any generation, once or twice, nothing of the result changes."""
    checkpoint = tmp_path_factory.mktemp("fit") / "fit.npz"
    stops = {at, at // 2} if again else {at}

    def run(stop: int | None) -> FitResult:
        calls = 0

        def evaluate(unit: np.ndarray) -> np.ndarray:
            nonlocal calls
            if calls == stop:
                raise KeyboardInterrupt
            calls += 1
            return sphere(unit)

        return run_fit(SPHERE, evaluate, checkpoint, problem="sphere")

    for stop in sorted(stops):
        with pytest.raises(KeyboardInterrupt):
            run(stop=min(stop, SPHERE.generations - 1 - _done(checkpoint)))
    assert same(run(None), run_fit(SPHERE, sphere))
    assert same(run(None), run_fit(SPHERE, sphere))  # of a finished fit too


def _done(checkpoint: Path) -> int:
    if not checkpoint.exists():
        return 0
    with np.load(checkpoint) as saved:
        return len(saved["losses"])


def test_a_finished_fit_can_go_on(tmp_path: Path) -> None:
    """More generations continue the same search: its settings but the number are the same."""
    checkpoint = tmp_path / "fit.npz"
    run_fit(replace(SPHERE, generations=5), sphere, checkpoint)
    assert same(run_fit(SPHERE, sphere, checkpoint), run_fit(SPHERE, sphere))


def test_polishing_is_done_once_and_kept(tmp_path: Path) -> None:
    checkpoint, polished = tmp_path / "fit.npz", []

    def polish(best: np.ndarray) -> np.ndarray:
        polished.append(best)
        return np.full(5, 0.7)

    first = run_fit(SPHERE, sphere, checkpoint, polish=polish)
    again = run_fit(SPHERE, sphere, checkpoint, polish=polish)
    assert first.loss == 0
    assert same(first, again)
    assert len(polished) == 1


def test_a_bad_polish_is_not_taken() -> None:
    plain = run_fit(SPHERE, sphere)
    assert same(run_fit(SPHERE, sphere, polish=lambda best: np.zeros(5)), plain)


def damages() -> dict[str, bytes]:
    return {"empty": b"", "text": b"no checkpoint", "zip": b"PK\x03\x04" + bytes(40)}


@pytest.mark.parametrize("name", damages())
def test_a_torn_checkpoint_is_refused(tmp_path: Path, name: str) -> None:
    checkpoint = tmp_path / "fit.npz"
    checkpoint.write_bytes(damages()[name])
    with pytest.raises(InputError, match=r"fit\.npz: not a checkpoint.*delete it"):
        run_fit(SPHERE, sphere, checkpoint)


@settings(max_examples=40)
@given(st.floats(0, 1, exclude_max=True), st.integers(0, 255))
def test_any_cut_or_flipped_byte_is_refused_or_harmless(
    tmp_path_factory: pytest.TempPathFactory, where: float, flip: int
) -> None:
    """Never a traceback, never another result."""
    checkpoint = tmp_path_factory.getbasetemp() / "damaged.npz"
    checkpoint.unlink(missing_ok=True)
    wanted = run_fit(SPHERE, sphere, checkpoint)
    whole = bytearray(checkpoint.read_bytes())
    at = int(where * len(whole))
    if flip:
        whole[at] ^= flip
    else:
        del whole[at:]
    checkpoint.write_bytes(whole)
    try:
        assert same(run_fit(SPHERE, sphere, checkpoint), wanted)
    except InputError as error:
        assert "damaged.npz" in str(error)


@pytest.mark.parametrize("change", ["seed", "sigma", "population", "start", "anchor", "problem"])
def test_a_checkpoint_of_another_fit_is_refused(tmp_path: Path, change: str) -> None:
    checkpoint = tmp_path / "fit.npz"
    run_fit(SPHERE, sphere, checkpoint, problem="a")
    others = {
        "seed": replace(SPHERE, seed=4),
        "sigma": replace(SPHERE, sigma=0.1),
        "population": replace(SPHERE, population=9),
        "start": replace(SPHERE, start=np.full(5, 0.41)),
        "anchor": replace(SPHERE, anchor=np.full(5, 0.4)),
        "problem": SPHERE,
    }
    problem = "b" if change == "problem" else "a"
    with pytest.raises(InputError, match="other recordings or settings"):
        run_fit(others[change], sphere, checkpoint, problem=problem)
    run_fit(SPHERE, sphere, checkpoint, problem="a")


def test_a_checkpoint_of_another_way_to_search_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its polished point is where other constants led."""
    checkpoint = tmp_path / "fit.npz"
    run_fit(SPHERE, sphere, checkpoint, polish=lambda best: np.full(5, 0.6))
    monkeypatch.setattr(fit, "SEARCH", fit.SEARCH + 1)
    with pytest.raises(InputError, match="other recordings or settings"):
        run_fit(SPHERE, sphere, checkpoint, polish=lambda best: np.full(5, 0.7))


def test_the_regulariser_pulls() -> None:
    """Minimum of (x - m)² + w (x - a)² per coordinate; a loss blind to a coordinate stays at a."""
    anchor = np.array([0.2, 0.2, 0.6, 0.6, 0.5])

    def blind(unit: np.ndarray) -> np.ndarray:
        return ((unit[:, :4] - 0.8) ** 2).sum(axis=1)

    settings = replace(SPHERE, sigma=0.05, generations=200, anchor=anchor, start=anchor)
    found = run_fit(settings, blind)
    wanted = np.append((0.8 + W_REG * anchor[:4]) / (1 + W_REG), 0.5)
    assert np.allclose(found.best, wanted, atol=2e-3)
    reached = blind(found.best[None])[0] + W_REG * ((found.best - anchor) ** 2).sum()
    assert found.loss == pytest.approx(reached)


def test_infinite_losses_are_survived() -> None:
    def half(unit: np.ndarray) -> np.ndarray:
        return np.where(unit[:, 0] < 0.5, np.inf, sphere(unit))

    found = run_fit(replace(SPHERE, generations=60), half)
    assert found.loss < 0.01
