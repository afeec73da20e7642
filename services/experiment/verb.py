"""The verb: from options to a plan, to its cells, to what they found."""

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from pup.errors import InputError
from pup.files import write_json
from pup.policy.shape import Method
from services import places
from services.experiment.cells import Cell, graph
from services.experiment.plan import Plan, read_plan, small
from services.experiment.run import failure, refuse_changed, run_again, run_cells, with_needed
from services.experiment.work import quiet
from services.held import held
from services.progress import counted

EXPERIMENT, REPORT = "experiment.json", "report.html"


def run(options: argparse.Namespace, out: Path) -> dict[str, Any]:
    """Do an experiment, or one of its cells again.

    Raises:
      InputError: the plan cannot be done, what was done for another would be deleted, or some of
        its cells failed for bad input alone.
      ChildProcessError: some failed otherwise.
      FailedError: another process works in the folder.
    """
    from services.experiment.gather import gather
    from services.experiment.report import write_report

    quiet()
    plan = plan_of(options)
    cells = graph(plan, options.policies, options.real)
    if not cells:
        raise InputError(
            f"nothing to do in {', '.join(plan.stages) or 'no stage'}: a diagnosed fleet is of two "
            "robots or more, the corrected are of walks of PUP; name other stages or seeds"
        )
    wanted = cells if options.cell is None else with_needed(cells, options.cell)
    with held(out):
        _keep(wanted, options, out)
        with places.cases(options) as (pools, _), counted("experiment") as tell:
            if options.cell is not None:
                return run_again(cells, options.cell, out, pools, tell)
            failed = run_cells(cells, out, pools, tell, options.redo)
        why = {name: told.error for name, told in failed.items()}
        document = gather(plan, cells, why, out.absolute())
        write_json(out / EXPERIMENT, document)
        write_report(document, out / REPORT)
    if failed:
        raise failure(failed, out)
    return {"experiment": document, "report": str(out / REPORT)}


def _keep(cells: Mapping[str, Cell], options: argparse.Namespace, out: Path) -> None:
    """Refuse to delete what was done for another plan, unless that is asked for."""
    if options.cell is not None:
        refuse_changed(cells, out, "do them anew with --redo and without --cell")
    elif not options.redo:
        refuse_changed(cells, out, "do them anew with --redo")


def plan_of(options: argparse.Namespace) -> Plan:
    """The plan that the options mean."""
    plan = small() if options.small else read_plan(options.plan) if options.plan else Plan()
    plan = replace(plan, robot=options.robot)
    known = tuple(Method)
    if unknown := [m for m in options.methods or () if m not in known]:
        raise InputError(f"--methods: {unknown[0]!r} is unknown; there are {', '.join(known)}")
    walked = {method for walk in plan.walks for method in walk.methods}
    if options.methods and not walked.intersection(options.methods):
        raise InputError(f"--methods: none of these is the plan's, {', '.join(sorted(walked))}")
    plan = plan.of(options.seeds, options.methods)
    return replace(plan, stages=options.stages) if options.stages else plan
