"""A diagnosis beside its rivals, the paper's NN-PD and a residual network, on the same data."""

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blind_sets import poor
from commandline import pup
from diagnoses import Maker
from diagnosis_cases import BENCH, recordings
from test_report import Page

from pup.diagnosis import rivals
from pup.diagnosis.coordinates import nominal_coordinate
from pup.diagnosis.fit import Fit
from pup.diagnosis.replays import Bench, Replays, threads
from pup.diagnosis.report_rivals import beside, takeaway
from pup.diagnosis.residuals import LOST, Measured, Noise
from pup.diagnosis.rivals import Errors, Rivals, _fitted, _rms, _start, compare
from pup.diagnosis.store import Store
from pup.diagnosis.wording import Speech
from pup.physics.parameters import robot_space
from pup.recording import load_recordings, write_recordings
from pup.robot import RobotDescription, TermSpec
from pup.robot_writer import write_corrected
from pup.sysid.accuracy import JointUnits
from pup.sysid.figures import drawing_style
from services.diagnosis import alone, run_diagnosis

FRICTION = {"coulomb_friction/torque@joint:servo": 0.03}
MODELS = ("nominal", "nn_pd", "residual_network", "diagnosed")
SECTION = "beside-its-rivals"


@dataclass(frozen=True)
class Done:
    """A diagnosis of a servo with friction, with its rivals."""

    document: dict[str, Any]
    out: Path

    @property
    def rivals(self) -> dict[str, Any]:
        return self.document["rivals"]


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Done:
    out = tmp_path_factory.mktemp("rivals")
    document = run_diagnosis(
        BENCH,
        recordings(FRICTION),
        out,
        alone(1),
        lambda stage, share: None,
        rivals=True,
        effects=1,
    )
    return Done(document, out)


def test_nn_pd_is_fitted(done: Done) -> None:
    fit = done.rivals["nn_pd_fit"]
    assert fit["rmse_after"] < 0.6 * fit["rmse_before"]


def test_the_box_of_its_weights_does_not_end_nn_pds_fit_at_its_beginning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A servo that sticks and rattles, and the nominal fit of a diagnosis of it."""
    terms = (
        TermSpec("stribeck_friction", "joint", "servo", {"torque": 0.03, "rest": 0.03}),
        TermSpec("backlash", "joint", "servo", {"gap": 0.01}),
    )
    write_corrected(BENCH, tmp_path / "robot", {}, terms)
    made = pup(
        *("record", "step:0.3", "triangle", "chirp", "hold", "--repeats", 2, "--seed", 3),
        *("--virtual", "--robot", tmp_path / "robot", "--out", tmp_path / "runs"),
    )
    assert made.code == 0, made.err
    measured = Measured.of(BENCH, load_recordings([tmp_path / "runs"], BENCH))
    space = robot_space(BENCH, "pd")
    gains = {"kp/servo": 4.163, "kd/servo": 0.0696, "tau_max/servo": 0.876, "armature": 0.001556}
    free = tuple(nominal_coordinate(space, name) for name in gains)
    nominal = Fit(free, np.array([c.coordinate(gains[c.name]) for c in free]))
    nothing = Maker(BENCH).nothing()
    found = replace(nothing, nominal=replace(nothing.nominal, fit=nominal), measured=measured)
    kept = Store(tmp_path / "kept", "").around(threads(Bench(measured, "nn_pd"), 1))
    replays = Replays(measured, robot_space(BENCH, "nn_pd"), kept, 1)
    noise = Noise(np.array([0.0011, 0.005, 0.005]), np.zeros(3), "repeats")
    coordinates, start = _start(found, replays.space)
    monkeypatch.setattr(rivals, "ITERATIONS", 3)  # enough to see that it has left its beginning
    fit = _fitted(coordinates, start, replays, noise)
    before, after = replays([fit.row(start), fit.row()])
    assert _rms(measured, after) < 0.95 * _rms(measured, before)


def test_the_diagnosis_beats_both_on_every_type_of_motion(done: Done) -> None:
    models = done.rivals["models"]
    best = models["diagnosed"]
    assert set(models) == set(MODELS)
    for name in ("nn_pd", "residual_network"):
        assert best["rmse"] < 0.7 * models[name]["rmse"]
        assert done.rivals["diagnosed_better_ci90"][name][0] > 0.2
        for motion, error in models[name]["per_motion"].items():
            assert best["per_motion"][motion] < 0.9 * error, (name, motion)


def test_they_are_judged_as_the_diagnosis_is(done: Done) -> None:
    """Same folds, same readings: the nominal and the diagnosed model have the errors told."""
    held = done.document["held_out"]
    for name, when in (("nominal", "before"), ("diagnosed", "after")):
        told = done.rivals["models"][name]
        assert told["rmse"] == pytest.approx(held[f"rmse_{when}"], rel=1e-6)
        for by in ("per_motion", "per_joint"):
            wanted = {key: pair[when] for key, pair in held[by].items()}
            assert told[by] == pytest.approx(wanted, rel=1e-6)


def test_the_file_holds_them_and_checkpoints_are_gone(
    done: Done, check_contract: Callable[[Path], None]
) -> None:
    check_contract(done.out / "diagnosis.json")
    assert json.loads((done.out / "diagnosis.json").read_text()) == done.document
    assert not (done.out / "checkpoints").exists()


def test_the_report_shows_them(done: Done) -> None:
    page = Page(done.out / "report.html")
    assert SECTION in {given.get("id") for given in page.all("section")}
    assert "it is the best in 4 of 4 types of motion" in page.text
    table = page.table("Model")
    assert table[0] == [
        "Model", "All", "step", "chirp", "triangle", "hold",
        "Corrected is better by (90 % interval)",
    ]  # fmt: skip
    names = ["nominal model", "NN-PD", "residual network", "corrected model"]
    assert [row[0] for row in table[1:]] == names
    wanted = [1000 * done.rivals["models"][name]["rmse"] for name in MODELS]
    assert [float(row[1]) for row in table[1:]] == pytest.approx(wanted, abs=0.051)


@pytest.fixture(scope="module")
def bench() -> Maker:
    return Maker(replace(BENCH, network=None), ticks=100)


@pytest.fixture
def one_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where one tells as much as the mean of several."""
    monkeypatch.setattr("pup.diagnosis.residual_network.MEMBERS", 1)


@pytest.fixture
def short_training(one_network: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where it does not matter how well it learns."""
    monkeypatch.setattr("pup.diagnosis.residual_network.STEPS", 300)


@pytest.mark.usefixtures("short_training")
def test_a_robot_without_a_network_has_one_rival_less(bench: Maker) -> None:
    found = bench.nothing()

    def replays_with(actuator: str) -> Replays:
        run = threads(Bench(found.measured, actuator), 1)
        return Replays(found.measured, robot_space(found.robot, actuator), run, 1)

    told = compare(found, replays_with)
    assert told is not None and told.nn_pd_fit is None
    assert set(told.errors) == set(MODELS) - {"nn_pd"}
    assert set(told.better) == {"nominal", "residual_network"}


@pytest.mark.usefixtures("short_training")
def test_one_seed_leads_to_one_result(bench: Maker) -> None:
    from pup.diagnosis.residual_network import mend

    found = bench.nothing()
    assert found.model is not None
    measured, predicted = found.measured, found.model.predicted
    first, second, other = (mend(measured, predicted, [[0]], seed) for seed in (0, 0, 1))
    assert np.array_equal(first, second)
    inside = measured.only([0])
    assert np.array_equal(first[~inside], predicted[~inside])
    assert (first != other)[inside].all()


@pytest.mark.usefixtures("one_network")
def test_the_network_learns_an_error_that_carries_over(bench: Maker) -> None:
    """One that grows with velocity, on motions alike: the fold left out is mended too."""
    from pup.diagnosis.residual_network import features, mend

    measured = bench.measured
    simulated = measured.values.copy()
    velocity = features(measured, simulated)[:, 2]
    predicted = simulated - 0.01 * velocity
    mended = mend(measured, predicted, [[0]], seed=0)
    errors = [
        np.sqrt(np.mean((measured.values - p)[measured.only([0])] ** 2))
        for p in (predicted, mended)
    ]
    assert errors[1] < 0.5 * errors[0]


def test_features_do_not_look_beyond_their_run(bench: Maker) -> None:
    from pup.diagnosis.residual_network import LAGS, features

    measured = bench.measured
    whole = features(measured, measured.values)
    changed = measured.values.copy()
    changed[measured.only([0])] += 0.1
    later = measured.only([1, 2])
    assert whole.shape == (len(measured.values), 1 + 3 * (LAGS + 1) + 1)
    assert np.array_equal(features(measured, changed)[later], whole[later])


def test_the_takeaway_follows_the_numbers() -> None:
    speech = Speech(BENCH, JointUnits.of(BENCH, recordings({})))
    errors = {
        "nominal": Errors(0.006, {"step": 0.006, "hold": 0.006}, {}),
        "residual_network": Errors(0.003, {"step": 0.004, "hold": 0.001}, {}),
        "diagnosed": Errors(0.002, {"step": 0.0015, "hold": 0.0022}, {}),
    }
    assert takeaway(errors, speech) == (
        "The corrected model's error on motions left out is the smallest: 2.0 mrad, against the "
        "residual network's 3.0 and the nominal model's 6.0; it is the best in 1 of 2 types of "
        "motion."
    )


def test_a_robot_of_several_joints_gets_a_table_of_them() -> None:
    """Without a correction: its model is the nominal one, and stands there once."""
    found = Maker(RobotDescription.load("darwin_leg"), ticks=20, most=2).nothing()
    motions = dict.fromkeys(("step", "chirp", "hold"), 0.003)
    told = Errors(0.003, motions, dict.fromkeys(found.robot.joint_names, 0.003))
    rivals = Rivals(dict.fromkeys(MODELS, told), {}, (0.02, 0.01))
    speech = Speech(found.robot, JointUnits.of(found.robot, found.measured.recordings))
    with drawing_style():
        text = "".join(beside(found, speech, rivals))
    assert "The same by joint [mrad]" in text and "left knee" in text
    assert "corrected model" not in text


def test_nothing_to_compare_where_nothing_can_be_told(tmp_path: Path) -> None:
    told = run_diagnosis(BENCH, poor(1), tmp_path, alone(1), lambda stage, share: None, rivals=True)
    assert told["verdict"] == "undetermined" and told["rivals"] is None
    assert SECTION not in (tmp_path / "report.html").read_text()


def test_pytorch_is_not_asked_for_unless_rivals_are() -> None:
    script = "import sys, services.cli, services.diagnosis; print('torch' in sys.modules)"
    told = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert told.stdout == "False\n", told.stderr


def test_without_pytorch_it_is_refused_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_recordings(poor(1), tmp_path / "runs")
    monkeypatch.setitem(sys.modules, "torch", None)
    done = pup("diagnose", tmp_path / "runs", "--robot", "servo_bench", "--local", "--rivals",
               "--out", tmp_path / "out")  # fmt: skip
    assert done.code == 2
    assert (
        "--rivals" in done.err
        and "PyTorch" in done.err
        and "constraints.txt '.[learn]'" in done.err
    )
    assert not (tmp_path / "out").exists()


def test_what_diverged_is_as_far_off_wherever_it_is() -> None:
    measured = Maker(BENCH).measured
    assert _rms(measured, np.full_like(measured.values, np.nan)) == pytest.approx(LOST)
