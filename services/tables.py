"""Short tables for the end of a command."""

from typing import Any

from rich.console import Console
from rich.table import Table

from pup.sysid.wording import thousandths


def plain() -> Console:
    """A console that prints names as they are: `walk[fast]` is no markup, `:a:` no emoji."""
    return Console(highlight=False, markup=False, emoji=False)


def bounds_table(document: dict[str, Any], unit: str) -> None:
    """Print the parameters, their bounds and the losses of a `bounds.json` document.

    Args:
      document: the document.
      unit: of joint positions.
    """
    console = plain()
    table = Table(title=f"{document['robot']}: parameters and bounds", title_justify="left")
    for column in ("parameter", "nominal", "lower", "upper", "unit", "identified"):
        numeric = column in ("nominal", "lower", "upper")
        table.add_column(column, justify="right" if numeric else "left", overflow="fold")
    for p in document["parameters"]:
        numbers = [f"{p[k]:.4g}" for k in ("nominal", "lower", "upper")]
        known = "yes" if p["identified"] else "no"
        at_end = ", at an end of its range" if p["at_end"] else ""
        table.add_row(p["name"], *numbers, p["unit"], known + at_end)
    console.print(table)
    train, held = document["loss"]["train"], document["loss"]["held_out"]
    if document["provenance"]["options"].get("as_described"):
        words = f"as described: loss {train['loss']:.3g}, RMSE {train['rmse']:.3g} {unit}"
    else:
        words = (
            f"loss {train['loss_before']:.3g} before, {train['loss']:.3g} after the fit; "
            f"RMSE {train['rmse_before']:.3g} {unit} before, {train['rmse']:.3g} {unit} after"
        )
    words += f", {held['rmse']:.3g} {unit} held out" if held else ""
    console.print(words, soft_wrap=True)
    console.print(f"{document['provenance']['seconds']:.0f} s")


def stages_table(documents: dict[str, Any]) -> None:
    """Print what the stages of a job took and found.

    Args:
      documents: of the stages by name, with `took` and `left_out`.
    """
    from services.job_report import TITLES, found, title

    console = plain()
    table = Table(title="stages", title_justify="left")
    table.add_column("stage")
    table.add_column("s", justify="right")
    table.add_column("found", overflow="fold")
    took = documents["took"]
    for name, words in found({name: documents[name] for name in took}).items():
        table.add_row(title(name), f"{took[name]:.0f}", words)
    for name, why in documents["left_out"].items():
        table.add_row(TITLES[name], "", f"left out: {why}")
    console.print(table)


def replay_table(document: dict[str, Any]) -> None:
    """Print the errors of a `replay.json` document."""
    console = plain()
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


def training_table(document: dict[str, Any]) -> None:
    """Print what a `training.json` document came to."""
    curve = document["curve"]
    lost = f", {document['lost_steps']:,} lost" if document["lost_steps"] else ""
    print(
        f"{document['robot']}: {document['method']}, {document['direction']}: "
        f"{document['steps']:,} steps{lost} in {document['seconds'] / 60:.1f} min"
    )
    if curve["distance"][-1] is not None:
        print(
            f"while still exploring: {curve['distance'][-1]:.2f} m in {curve['time'][-1]:.1f} s "
            "an episode; `pup replay --policy` shows the policy itself"
        )


def walk_table(document: dict[str, Any]) -> None:
    """Print how far a policy of a `replay.json` document walked."""
    shown = document["shown"]
    end = "fell" if shown["fell"] else "stayed up"
    print(f"{document['robot']}: {document['method']}, {document['direction']}")
    print(f"fitted parameters: {shown['distance']:.2f} m in {shown['time']:.1f} s, {end}")
    print(
        f"{document['episodes']} episodes with parameters from the bounds: median "
        f"{document['distance_median']:.2f} m in {document['time_median']:.1f} s, "
        f"{document['upright_share']:.0%} without a fall, {document['aside_median']:.2f} m aside"
    )
    if document["fitted_eta"]:
        eta = ",".join(f"{entry:.4f}" for entry in document["fitted_eta"])
        print(f"eta of the fitted parameters: {eta}")
    print(f"video: {document['video']}, drawn by {document['drawn_by']}")


def diagnosis_table(document: dict[str, Any]) -> None:
    """Print the verdict and the findings of a `diagnosis.json` document."""
    unit = " or ".join(f"m{part}" for part in document["position_unit"].split(" or "))

    def small(error: float) -> str:
        return f"{thousandths(error)} {unit}"

    console = plain()
    console.print(f"{document['robot']}: {document['verdict']}", style="bold")
    if document["reason"]:
        console.print(document["reason"], soft_wrap=True)
    if document["findings"]:
        table = Table(title_justify="left")
        for column in ("effect", "place", "probability", "or", "hidden in"):
            table.add_column(column, justify="right" if column == "probability" else "left")
        for found in document["findings"]:
            others = ", ".join(
                f"{o['effect']} ({o['probability']:.0%})" for o in found["equivalents"]
            )
            hidden = ", ".join(f"{n} {s:+.0%}" for n, s in list(found["absorbed_by"].items())[:2])
            place = f"{found['place']['kind']} {', '.join(found['place']['names'])}"
            table.add_row(found["effect"], place, f"{found['probability']:.0%}", others, hidden)
        console.print(table)
    held = document["held_out"]
    if held:
        before, after = (small(held[f"rmse_{when}"]) for when in ("before", "after"))
        floor = document["noise_floor"]
        console.print(
            f"on motions left out: {before} before, {after} after; "
            f"noise floor {small(floor['rms'])} ({floor['source']})",
            soft_wrap=True,
        )
    if document.get("rivals"):
        models = document["rivals"]["models"].items()
        told = ", ".join(f"{name} {small(model['rmse'])}" for name, model in models)
        console.print(f"beside rivals: {told}", soft_wrap=True)


def experiment_table(shown: dict[str, Any]) -> None:
    """Print what an experiment came to, or whether a cell that was done again agrees."""
    if "agree" in shown:
        agrees = "agrees with what it found before" if shown["agree"] else "DIFFERS from before"
        print(f"{shown['cell']}: done again, {agrees}")
        for folder, digest in shown["results"].items():
            print(f"{digest[:16]}  {folder}")
        return
    from services.experiment.report import estimated

    console = plain()
    table = Table(title="what was to be shown", title_justify="left")
    table.add_column("line", overflow="fold")
    for column in ("found", "robots", "bar", ""):
        table.add_column(column, justify="right")
    for line in shown["experiment"]["acceptance"]:
        robots = f"{line['robots']} of {line['planned']}"
        table.add_row(line["line"], estimated(line), robots, f"{line['bar']:g}", line["answer"])
    if table.row_count:
        console.print(table)
    print(f"report: {shown['report']}")
