"""Cases of bad input for the command line, and what a refusal is."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from commandline import TINY, Outcome, files, pup

LOG = "time,target/servo,position/servo\n0,0,0\n0.1,1,0.5\n"
TOLD = ("--motion", "step", "--support", "bench")
"""A log, and what it does not tell."""


@dataclass(frozen=True)
class Place:
    """Where a case works: its folder, and good recordings of a leg and of a servo."""

    here: Path
    leg: Path
    bench: Path

    @property
    def out(self) -> Path:
        return self.here / "out"

    def write(self, name: str, content: bytes | str) -> Path:
        path = self.here / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    def replay(self, *recordings: object, robot: object = "servo_bench") -> list[object]:
        return ["replay", *recordings, "--robot", robot, "--out", self.out]

    def presysid(self, *options: object) -> list[object]:
        given = ["presysid", self.bench, "--robot", "servo_bench", "--out", self.out]
        return [*given, *TINY, *options]

    def importing(self, format: str, *options: object) -> list[object]:
        return ["import", format, *options, "--out", self.out]

    def record(self, *options: object) -> list[object]:
        return ["record", *options, "--virtual", "--robot", "darwin_leg", "--out", self.out]


def assert_refused(done: Outcome, *words: object) -> None:
    (line,) = done.err.splitlines()
    assert done.code == 2, done.err
    assert line.startswith("pup")
    for word in words:
        assert str(word) in line, line
    assert done.out == ""


Made = tuple[list[object], tuple[object, ...]]
"""A command, and words that its one line must hold."""
Case = Callable[[Place], Made]


class Cases(dict[str, Case]):
    """Cases by name."""

    def __call__(self, name: str) -> Callable[[Case], Case]:
        """Register a case."""

        def register(made: Case) -> Case:
            assert name not in self
            self[name] = made
            return made

        return register


def check(place: Place, made: Made) -> None:
    """A command is refused and leaves nothing."""
    command, words = made
    before = files(place.here)
    assert_refused(pup(*command), *words)
    assert files(place.here) == before
    assert not place.out.exists()
