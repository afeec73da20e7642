"""Short tables for the end of a command."""

from typing import Any

from rich.console import Console
from rich.table import Table


def bounds_table(document: dict[str, Any], unit: str) -> None:
    """Print the parameters, their bounds and the losses of a `bounds.json` document.

    Args:
      document: the document.
      unit: of joint positions.
    """
    console = Console(highlight=False)
    table = Table(title=f"{document['robot']}: parameters and bounds", title_justify="left")
    for column in ("parameter", "nominal", "lower", "upper", "unit", "identified"):
        numeric = column in ("nominal", "lower", "upper")
        table.add_column(column, justify="right" if numeric else "left", overflow="fold")
    for p in document["parameters"]:
        numbers = [f"{p[k]:.4g}" for k in ("nominal", "lower", "upper")]
        table.add_row(p["name"], *numbers, p["unit"], "yes" if p["identified"] else "no")
    console.print(table)
    train, held = document["loss"]["train"], document["loss"]["held_out"]
    console.print(
        f"loss {train['loss_before']:.3g} before, {train['loss']:.3g} after the fit; "
        f"RMSE {train['rmse_before']:.3g} {unit} before, {train['rmse']:.3g} {unit} after"
        + (f", {held['rmse']:.3g} {unit} held out" if held else ""),
        soft_wrap=True,
    )
    console.print(f"{document['provenance']['seconds']:.0f} s")


def replay_table(document: dict[str, Any]) -> None:
    """Print the errors of a `replay.json` document."""
    console = Console(highlight=False)
    table = Table(title=f"{document['robot']}: replayed", title_justify="left")
    table.add_column("recording", overflow="fold")
    table.add_column(f"RMSE, {document['unit']}", justify="right")
    for name, rms in document["per_recording"].items():
        broken = " (broke down)" if name in document["diverged"] else ""
        table.add_row(f"{name}{broken}", f"{rms:.3g}")
    table.add_section()
    table.add_row("all", f"{document['rmse']:.3g}")
    console.print(table)
    console.print(f"model: {document['actuator']}, {document['model']}", soft_wrap=True)
