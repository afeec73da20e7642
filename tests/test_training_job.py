"""`pup train` as a user has it, in a process of its own: stopped, resumed, and shown walking."""

import os
import signal
from pathlib import Path

import numpy as np
import pytest
from commandline import pup
from jobs import Job

from pup.files import read_json
from services.gateway.artefacts import read as read_document
from services.gateway.documents import TrainingDocument
from services.transfer import read_simulated

pytest.importorskip("torch")
pytest.importorskip("gymnasium")

SMALL = ("--simulations", 4, "--length", 8, "--minibatch", 16, "--pattern", 0, "--cores", 1)


@pytest.mark.ray
def test_a_stopped_training_says_so_and_leaves_nothing_running(tmp_path: Path) -> None:
    """Exit code 130, no process of its Ray; a walk of what it left afterwards, and its refusals."""
    out = tmp_path / "out"
    job = Job("train", *SMALL, "--steps", 10**9, out=out)
    job.come_to("ray")
    job.come_to("tensorboard/events*")
    os.kill(job.pid, signal.SIGTERM)
    code, printed, told = job.end()
    assert (code, printed) == (130, ""), told
    assert told.splitlines()[-1] == "pup train: stopped; the same command resumes"
    job.assert_nothing_left()
    job = Job("train", *SMALL, "--steps", 1000, out=tmp_path / "short")
    code, printed, told = job.end()
    assert code == 0, told
    job.assert_nothing_left()
    shown = read_document(tmp_path / "short" / "training.json", TrainingDocument)
    assert shown.done and shown.curve.steps[-1] == shown.steps >= 1000  # as pages show it
    policy = tmp_path / "short" / "policy"
    walk = ("replay", "--policy", policy, "--robot", "darwin_op2", "--episodes", 4, "--json")
    shown = pup(*walk, "--landscape", 2, "--out", tmp_path / "walk").json()
    assert len(shown["distance"]) == len(shown["fell"]) == 4
    assert shown["shown"]["time"] > 0
    assert shown["eta"] is None and len(shown["fitted_eta"]) == 3
    assert (tmp_path / "walk" / "gait.png").read_bytes().startswith(b"\x89PNG")
    assert Path(shown["video"]).stat().st_size > 1000
    assert shown["drawn_by"] in ("mujoco", "matplotlib")
    simulated = read_simulated(tmp_path / "walk" / "simulated.json")
    assert read_json(tmp_path / "walk" / "simulated.json")["control_rate"] == [33.0, 33.0]
    assert np.shape(simulated["eta"]) == (2, 3) and np.shape(simulated["distance"]) == (16, 2)
    eta = ",".join(map(str, (-0.5, *shown["fitted_eta"][1:])))
    conditioned = pup(*walk, "--out", tmp_path / "conditioned", "--eta", eta).json()
    assert conditioned["eta"] == [-0.5, *shown["fitted_eta"][1:]]
    assert pup(*walk, "--out", tmp_path / "other", "--eta", "0,0").code == 2
    leg = ("replay", "--policy", policy, "--robot", "darwin_leg", "--out", tmp_path / "other")
    refused = pup(*leg)
    assert refused.code == 2 and "'darwin_op2'" in refused.err
