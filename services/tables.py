"""Short tables for the end of a command."""

from typing import Any

from rich.console import Console
from rich.table import Table


def bounds_table(document: dict[str, Any]) -> None:
    """Print the parameters, their bounds and the losses of a `bounds.json` document."""
    console = Console()
    table = Table(title=f"{document['robot']}: parameters and bounds", title_justify="left")
    for column in ("parameter", "nominal", "lower", "upper", "unit", "identified"):
        numeric = column in ("nominal", "lower", "upper")
        table.add_column(column, justify="right" if numeric else "left")
    for p in document["parameters"]:
        numbers = [f"{p[k]:.4g}" for k in ("nominal", "lower", "upper")]
        table.add_row(p["name"], *numbers, p["unit"], "yes" if p["identified"] else "no")
    console.print(table)
    train, held = document["loss"]["train"], document["loss"]["held_out"]
    console.print(
        f"loss {train['loss_before']:.3f} before, {train['loss']:.3f} after the fit; "
        f"RMSE {1e3 * train['rmse_before']:.1f} before, {1e3 * train['rmse']:.1f} mrad after"
        + (f", {1e3 * held['rmse']:.1f} mrad held out" if held else "")
    )
    console.print(f"{document['provenance']['seconds']:.0f} s")
