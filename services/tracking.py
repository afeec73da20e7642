"""Where a training's curve is told beside its files: TensorBoard, and others when asked for."""

from importlib.util import find_spec
from pathlib import Path
from typing import Any
from uuid import uuid4

from pup.errors import InputError
from pup.files import read_json, write_json

OTHERS = ("wandb", "mlflow")
PROJECT = "pup"
RUNS = "tracking.json"
"""The runs' names with others: a training that resumes goes on with them."""


def check(track: tuple[str, ...]) -> None:
    """Refuse trackers that are not installed.

    Raises:
      InputError: one is not.
    """
    for name in track:
        if find_spec(name) is None:
            raise InputError(
                f"--track {name} needs the package {name}, which is not installed; install it or "
                "leave it out"
            )


class Trackers:
    """Tells numbers by name, an iteration at a time.

    Args:
      track: those to tell beside TensorBoard, of OTHERS.
      out: folder of the training.
      done: iterations that were told before; what TensorBoard has of later ones is void.
      options: of the training, told once.
    """

    def __init__(
        self, track: tuple[str, ...], out: Path, done: int, options: dict[str, Any]
    ) -> None:
        self.track, self.out, self.done, self.options = track, out, done, options

    def __enter__(self) -> "Trackers":
        from tensorboardX import SummaryWriter

        folder = str(self.out / "tensorboard")
        self.board = SummaryWriter(folder, purge_step=self.done + 1, max_queue=1000)
        runs = self._runs()
        if "wandb" in self.track:
            import wandb

            self.run = wandb.init(
                project=PROJECT,
                dir=str(self.out),
                config=self.options,
                id=runs.setdefault("wandb", uuid4().hex),
                resume="allow",
            )
        if "mlflow" in self.track:
            import mlflow

            mlflow.set_experiment(PROJECT)
            known = runs.get("mlflow")
            runs["mlflow"] = mlflow.start_run(run_id=known).info.run_id
            if known is None:
                mlflow.log_params(_flat(self.options))
        if runs:
            write_json(self.out / RUNS, runs)
        return self

    def _runs(self) -> dict[str, str]:
        """The runs of a training that goes on; none of one that begins anew."""
        file = self.out / RUNS
        told = read_json(file) if self.done and file.exists() else {}
        return {name: run for name, run in told.items() if isinstance(run, str)}

    def tell(self, row: dict[str, Any], iteration: int) -> None:
        """Tell the numbers of an iteration."""
        numbers = {name: float(v) for name, v in row.items() if v is not None}
        for name, value in numbers.items():
            self.board.add_scalar(name, value, iteration)
        if "wandb" in self.track:
            self.run.log(numbers, step=iteration)
        if "mlflow" in self.track:
            import mlflow

            mlflow.log_metrics(numbers, step=iteration)

    def __exit__(self, *_: object) -> None:
        self.board.close()
        if "wandb" in self.track:
            self.run.finish()
        if "mlflow" in self.track:
            import mlflow

            mlflow.end_run()


def _flat(options: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in options.items():
        nested = isinstance(value, dict)
        flat |= _flat(value, f"{prefix}{name}.") if nested else {f"{prefix}{name}": value}
    return flat
