"""Exports draw commands as what they are: held until the next."""

from pathlib import Path

import rerun as rr
from recordings import make
from rerun.chunk import RrdReader

from pup.exporters import Take, export_takes


def test_rerun_holds_commands_until_the_next(tmp_path: Path) -> None:
    export_takes("rrd", [Take(make())], tmp_path)
    held = [rr.components.InterpolationMode.StepAfter.value]
    for source, modes in (("target", [held]), ("real", [])):
        chunks = RrdReader(tmp_path / "r1.rrd").stream().filter(content=f"/position/a/{source}")
        told = [c.to_record_batch().to_pydict() for c in chunks.to_chunks() if c.is_static]
        assert [m for t in told for m in t.get("SeriesLines:interpolation_mode", [])] == modes
