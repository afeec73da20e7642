"""Walks of a study made again in simulation, and studies that are none."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commandline import pup

from pup.errors import InputError
from pup.files import sha256
from pup.policy.bundle import CARD, NumpyPolicy
from pup.recording import Recording
from pup.robot import RobotDescription
from services.rehearsal import read_walked, rehearsal_words, rehearse

ROBOT = RobotDescription.load("darwin_op2")
POLICY = ROBOT.folder / "policies" / "forward"
BUNDLE = NumpyPolicy.load(POLICY, ROBOT)
DIGEST = sha256(POLICY / CARD)
CARDED = np.array([BUNDLE.card.eta_lower, BUNDLE.card.eta_upper])
ETAS = [(CARDED[0] + share * (CARDED[1] - CARDED[0])).tolist() for share in (0.2, 0.5, 0.8)]


def trial(eta: list[float], distance: float | None, time: float | None = 1.5, **more: Any) -> Any:
    return {"eta": eta, "distance": distance, "time": time, "state": "succeeded"} | more


def study(file: Path, *trials: Any, **more: Any) -> Path:
    told = {"schema": 1, "policy": DIGEST, "settings": {"horizon": 1.5}, "trials": trials}
    file.write_text(json.dumps(told | more))
    return file


def again(file: Path, out: Path, rate: float | None = None) -> dict[str, Any]:
    return rehearse(ROBOT, POLICY, ROBOT.identified_path, file, out, 0, threads=2, rate=rate)


def recorded(folder: Path, name: str, ticks: Any) -> str:
    """A recording of a walk where a laboratory leaves it, by how long its ticks took, s."""
    time = np.concatenate([[0.0], np.cumsum(ticks)])
    still = np.tile(ROBOT.limits[0], (len(time), 1))
    kind = {"motion": "walk", "support": "ground", "source": "simulation"}
    told = {"joints": ROBOT.joint_names, "time": time, "target": still, "position": still}
    walk = Recording(name, "darwin_op2", **kind, **told)
    walk.write(folder / "agent" / "recordings" / f"{name}.parquet")
    return name


def test_trials_are_gathered_by_eta(tmp_path: Path) -> None:
    file = study(
        tmp_path / "study.json",
        trial(ETAS[0], 1.0, 10.0),
        trial(ETAS[1], 0.5, 4.0),
        trial(ETAS[0], 2.0, 14.0),
        trial(ETAS[2], None, None, state="aborted"),
    )
    walked = read_walked(file, BUNDLE, DIGEST)
    np.testing.assert_allclose(walked.eta, ETAS[:2])
    np.testing.assert_allclose(walked.distance, (1.5, 0.5))
    np.testing.assert_allclose(walked.time, (12.0, 4.0))
    assert walked.walks.tolist() == [2, 1] and walked.horizon == 1.5


def test_a_simulator_foretells_its_own_walks(tmp_path: Path) -> None:
    """What it walks is what it walked, to the last digit; others are as far apart as they are."""
    other = study(tmp_path / "other.json", *(trial(eta, 1.0, 9.0) for eta in ETAS))
    first = again(other, tmp_path / "out")
    assert first["apart"] == pytest.approx(1.0 - first["simulated_distance"])
    assert not first["walks_alike"]  # 1.5 s are simulated, and 9 s were walked
    assert first["rank_correlation"] is None  # the robot walks all etas alike
    assert "trust no policy" in rehearsal_words(first)
    assert (tmp_path / "out" / "rehearsal.png").read_bytes().startswith(b"\x89PNG")
    falls = study(tmp_path / "falls.json", *(trial(eta, 0.0, 0.5) for eta in ETAS))
    bold = again(falls, tmp_path / "bold")
    assert not bold["walks_alike"]  # what is simulated stays up for longer
    assert "walks where the robot falls" in rehearsal_words(bold)
    told = [trial(e["eta"], e["simulated_distance"], e["simulated_time"]) for e in first["etas"]]
    own = again(study(tmp_path / "own.json", *told), tmp_path / "own")
    assert own["apart"] == pytest.approx(0.0, abs=1e-12)
    assert own["rank_correlation"] == pytest.approx(1.0)
    assert own["walks_alike"] and "trust" not in rehearsal_words(own)
    assert json.loads((tmp_path / "own" / "rehearsal.json").read_text()) == own


def test_walks_are_made_again_at_the_rate_of_the_robot(tmp_path: Path) -> None:
    """Of its recordings, where they are there; a tick that was late does not tell it."""
    ticks = np.tile([0.031, 0.031, 0.031, 0.045], 5)
    walks = [
        trial(ETAS[0], 1.0, recording=recorded(tmp_path, "run_1_1", ticks)),
        trial(ETAS[0], 1.0, recording=recorded(tmp_path, "run_2_1", ticks)),
        trial(ETAS[1], 1.0, recording="run_3_1"),  # is gone
    ]
    file = study(tmp_path / "study.json", *walks)
    assert again(file, tmp_path / "own")["control_rate"] == pytest.approx(1 / 0.031)
    (tmp_path / "alone").mkdir()
    alone = study(tmp_path / "alone" / "study.json", *walks)
    fast = again(alone, tmp_path / "fast")
    assert fast["control_rate"] == 33.0  # as an agent has it
    slow = again(file, tmp_path / "slow", 25.0)
    assert slow["control_rate"] == 25.0
    assert slow["simulated_distance"] != fast["simulated_distance"]
    with pytest.raises(InputError, match="trained for 25 to 33 Hz, not 50"):
        again(file, tmp_path / "out", 50.0)


@pytest.mark.parametrize(
    ("trials", "more", "said"),
    [
        ([trial(ETAS[0], 1.0)], {"schema": 2}, "not a study.json"),
        ([trial(ETAS[0], 1.0)], {"settings": {}}, "not a study.json"),
        ([trial(ETAS[0], "far")], {}, "not a study.json"),
        ([trial(ETAS[0], 1.0)], {"policy": "0" * 64}, "another policy"),
        ([trial(ETAS[0], None, state="lost")], {}, "no walk"),
        ([trial([0.0, 0.0], 1.0)], {}, "none of this policy"),
        ([trial(ETAS[0], float("nan"))], {}, "none of this policy"),
        ([trial([0.0, 0.0, float("nan")], 1.0)], {}, "none of this policy"),
        ([trial(ETAS[0], 10**400)], {}, "not a study.json"),
    ],
)
def test_studies_that_cannot_be_walked_again(
    tmp_path: Path, trials: list[Any], more: dict[str, Any], said: str
) -> None:
    file = study(tmp_path / "study.json", *trials, **more)
    with pytest.raises(InputError, match=said) as refused:
        read_walked(file, BUNDLE, DIGEST)
    assert str(file) in str(refused.value)


def test_the_command_says_it_in_a_sentence(tmp_path: Path) -> None:
    file = study(tmp_path / "study.json", *(trial(eta, 0.1) for eta in ETAS))
    command = ("replay", "--robot", "darwin_op2", "--study", file, "--out", tmp_path / "out")
    done = pup(*command, "--policy", POLICY)
    assert done.code == 0, done.err
    assert done.out.startswith("3 etas: 0.10 m in 1.5 s by the robot")
    refused = pup(*command, tmp_path)
    assert refused.code == 2 and "--policy" in refused.err
    refused = pup(*command, "--policy", POLICY, "--landscape", 4)
    assert refused.code == 2 and "--landscape" in refused.err
    refused = pup(*command, "--policy", POLICY, "--rate", 50)
    assert refused.code == 2 and "not 50" in refused.err
    shown = ("replay", "--robot", "darwin_op2", "--policy", POLICY, "--out", tmp_path / "out")
    refused = pup(*shown, "--rate", 30)
    assert refused.code == 2 and "--rate" in refused.err
    refused = pup(*shown, "--rate", 50, "--landscape", 4)
    assert refused.code == 2 and "not 50" in refused.err
