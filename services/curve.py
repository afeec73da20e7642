"""A training's curve: a point for each iteration, and the plot."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pup.files import write_atomic
from pup.sysid.figures import BLUE, as_png, drawing_style, new_figure

if TYPE_CHECKING:
    from workers.ppo import Iteration

PANELS = (
    ("distance", "distance at the end of an episode, m"),
    ("time", "time before the fall, s"),
    ("reward", "reward of a step"),
    ("kl", "divergence of an iteration, nats"),
)


def point(told: "Iteration", before: int, seconds: float) -> dict[str, Any]:
    """A point of the curve; nothing where no episode ended.

    Args:
      told: what the iteration came to.
      before: steps sampled before it.
      seconds: of the training so far.
    """
    means = told.ended.mean(axis=0) if len(told.ended) else np.full(4, np.nan)
    names = ("return", "distance", "time", "fell")
    row = {
        "steps": before + told.steps,
        "seconds": seconds,
        "episodes": len(told.ended),
        **dict(zip(names, map(float, means), strict=True)),
        "reward": told.reward,
        "sampling_seconds": told.seconds[0],
        "learning_seconds": told.seconds[1],
        **told.learnt,
    }
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in row.items()}


def draw_curve(file: Path, document: dict[str, Any]) -> None:
    """Draw what the exploring policy came to over the steps of its training.

    Args:
      file: PNG to write.
      document: of `training.json`.
    """
    curve = document["curve"]
    steps = np.array(curve["steps"]) / 1e6
    with drawing_style():
        figure = new_figure(9.0, 5.5)
        for i, (name, title) in enumerate(PANELS):
            axes = figure.add_subplot(2, 2, i + 1)
            axes.plot(steps, np.array(curve[name], dtype=float), color=BLUE, linewidth=1.2)
            axes.set_title(title, fontsize=9)
            axes.set_xlabel("million steps")
        figure.suptitle(
            f"{document['robot']}, {document['method']}, {document['direction']}: "
            f"{document['steps'] / 1e6:.1f} M steps in {document['seconds'] / 60:.0f} min"
        )
        write_atomic(file, as_png(figure))
