"""docs/deploy.md: commands that can be typed."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

from manifests import ROOT

from hardware_agent.cli import PLACE
from services.arguments import parser

TEXT = (ROOT / "docs/deploy.md").read_text()


def commands() -> Iterator[list[str]]:
    for block in re.findall(r"```sh\n(.*?)```", TEXT, re.DOTALL):
        for line in block.replace("\\\n", " ").splitlines():
            yield shlex.split(line.partition(" | ")[0].partition(" > ")[0], comments=True)


def test_commands_of_pup_are_taken() -> None:
    checked = 0
    for words in commands():
        if words[:2] == ["docker", "compose"] and "run" in words:
            words = ["pup", "serve", *words[words.index("gateway") + 1 :]]
        elif "--" in words:
            words = words[words.index("--") + 1 :]
        if words and words[0] == "pup":
            parser().parse_args(words[1:])
            checked += 1
    assert checked == 6


def test_recordings_are_copied_to_the_same_place_again_and_again() -> None:
    """Of a folder itself the second copy would stand inside the first one; kubectl's always so."""
    assert "kubectl cp" not in TEXT.replace("-n pup ", "")
    copied = [words for words in commands() if words[:2] == ["docker", "compose"] and "cp" in words]
    assert copied and all(words[words.index("cp") + 1].endswith("/.") for words in copied)


def test_files_that_are_named_are_there() -> None:
    named = {word for words in commands() for word in words if word.startswith("deploy/")}
    assert len(named) >= 7
    assert all((ROOT / name).exists() for name in named if "secrets/" not in name)
    for place in re.findall(r"\]\(([\w.-]+\.md)(?:#[\w'-]+)?\)", TEXT):
        assert (ROOT / "docs" / place).exists()
    assert Path(PLACE).parent.name in (ROOT / "deploy/compose.agent.yaml").read_text()


def test_headings_that_are_linked_are_there() -> None:
    for file, heading in re.findall(r"\]\(([\w.-]+\.md)#([\w'-]+)\)", TEXT):
        titles = re.findall(r"^#+ (.*)$", (ROOT / "docs" / file).read_text(), re.MULTILINE)
        assert heading in {re.sub(r"[^\w -]", "", t).lower().replace(" ", "-") for t in titles}
