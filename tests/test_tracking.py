"""What others are told of a training's curve, by stand-ins for their packages."""

import json
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from services.tracking import Trackers

OPTIONS = {"steps": 10, "learning": {"rate": 1e-4}}


class Others:
    """Weights & Biases and MLflow as far as they are called: which runs were told what."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.runs: dict[str, dict[int, dict[str, float]]] = {}
        self.options: dict[str, list[dict[str, Any]]] = {}
        wandb, mlflow = ModuleType("wandb"), ModuleType("mlflow")
        vars(wandb).update(init=self._init)
        for name in ("start_run", "log_params", "log_metrics"):
            setattr(mlflow, name, getattr(self, f"_{name}"))
        for name in ("set_experiment", "end_run"):
            setattr(mlflow, name, lambda *_: None)
        monkeypatch.setitem(sys.modules, "wandb", wandb)
        monkeypatch.setitem(sys.modules, "mlflow", mlflow)

    def _init(self, project: str, dir: str, config: dict, id: str, resume: str) -> SimpleNamespace:
        assert (project, resume) == ("pup", "allow")
        told = self.runs.setdefault(id, {})
        self.options.setdefault(id, []).append(config)
        return SimpleNamespace(log=lambda row, step: told.update({step: row}), finish=lambda: None)

    def _start_run(self, run_id: str | None = None) -> SimpleNamespace:
        self.now = run_id or f"run{len(self.runs)}"
        self.runs.setdefault(self.now, {})
        return SimpleNamespace(info=SimpleNamespace(run_id=self.now))

    def _log_params(self, options: dict[str, Any]) -> None:
        self.options.setdefault(self.now, []).append(options)

    def _log_metrics(self, row: dict[str, float], step: int) -> None:
        self.runs[self.now][step] = row


def tell(track: tuple[str, ...], out: Path, done: int) -> None:
    """Two iterations after those that are done."""
    with Trackers(track, out, done, OPTIONS) as trackers:
        for i in (done + 1, done + 2):
            trackers.tell({"distance": 0.1 * i, "kl": None}, i)


@pytest.mark.parametrize("name", ["wandb", "mlflow"])
def test_a_training_that_resumes_goes_on_with_its_run(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    others = Others(monkeypatch)
    tell((name,), tmp_path, 0)
    tell((name,), tmp_path, 2)
    (run,) = others.runs
    assert json.loads((tmp_path / "tracking.json").read_text()) == {name: run}
    assert others.runs[run] == {i: {"distance": pytest.approx(0.1 * i)} for i in range(1, 5)}
    assert len(others.options[run]) == (2 if name == "wandb" else 1)
    tell((name,), tmp_path, 0)  # a training that begins anew
    assert len(others.runs) == 2


def test_both_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    others = Others(monkeypatch)
    tell(("wandb", "mlflow"), tmp_path, 0)
    assert set(json.loads((tmp_path / "tracking.json").read_text()).values()) == set(others.runs)
    assert others.options["run1"] == [{"steps": 10, "learning.rate": 1e-4}]
