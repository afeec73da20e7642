"""The example of docs/robots.md: a robot of one's own needs no Python."""

import json
import re
import shlex
from pathlib import Path

import pytest
from commandline import TINY, pup, pup_process

from pup.robot import RobotDescription
from pup.robot_space import EDIT_FIELDS, GROUP_KINDS, ROBOT_KINDS

DOCS = Path(__file__).parents[1] / "docs"


def blocks(page: str, language: str) -> list[str]:
    """The code blocks of one language."""
    text = (DOCS / page).read_text()
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where a reader has saved the example's two files."""
    folder = tmp_path_factory.mktemp("reader")
    (folder / "two_link").mkdir()
    (toml, _), (xml,) = blocks("robots.md", "toml"), blocks("robots.md", "xml")
    (folder / "two_link" / "robot.toml").write_text(toml)
    (folder / "two_link" / "model.xml").write_text(xml)
    return folder


def test_the_example_is_a_robot(folder: Path) -> None:
    robot = RobotDescription.load(folder / "two_link")
    assert robot.name == "two_link"
    assert robot.joint_names == ("shoulder", "elbow")
    assert robot.setup({"payload": 0.2}) == {"payload": 0.2}


@pytest.mark.usefixtures("short_polish")
def test_the_commands_of_the_page_work(folder: Path) -> None:
    commands, *_ = blocks("robots.md", "sh")
    for command in commands.splitlines():
        _, *arguments = shlex.split(command)
        done = pup_process(*arguments, folder=folder)
        assert done.code == 0, done.err
    replayed = json.loads((folder / "two_link_replay" / "replay.json").read_text())
    assert list(replayed["per_joint"]) == ["shoulder", "elbow"]
    assert 0 < replayed["rmse"] < 0.3
    assert (folder / "two_link_replay" / "step_0.3.png").is_file()

    (command,) = re.findall(r"`pup (presysid [^`]*)`", (DOCS / "robots.md").read_text())
    recordings, out = folder / "two_link_recordings", folder / "two_link_bounds"
    assert command == f"presysid {recordings.name} --robot two_link --out {out.name}"
    done = pup("presysid", recordings, "--robot", folder / "two_link", "--out", out, *TINY)
    assert done.code == 0, done.err
    assert json.loads((out / "bounds.json").read_text())["robot"] == "two_link"


def test_the_page_knows_every_parameter_and_field() -> None:
    page = (DOCS / "robots.md").read_text()
    for kind in GROUP_KINDS:
        assert f"| `{kind}/<group>` |" in page
    assert "`torso_com/x`, `/y`, `/z`" in page
    for name in ROBOT_KINDS:
        assert name.startswith("torso_com/") or f"| `{name}` |" in page
    for field in EDIT_FIELDS:
        assert f"`{field}`" in page


@pytest.mark.parametrize("page", ["robots.md", "recordings.md", "physics.md", "../README.md"])
def test_links_lead_somewhere(page: str) -> None:
    file = DOCS / page
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", file.read_text()):
        assert (file.parent / target).exists(), target


def test_the_pages_name_options_that_exist() -> None:
    """Every `pup VERB ... --option` of the pages is one that the verb's help tells."""
    for page in ("robots.md", "real-robot.md", "run.md", "recordings.md", "../README.md"):
        for block in blocks(page, "sh"):
            for line in block.replace("\\\n", " ").splitlines():
                if not line.startswith("pup "):
                    continue
                verb = shlex.split(line)[1]
                told = pup(verb, "--help").out
                for option in re.findall(r" (--[a-z-]+)", line):
                    assert option in told, line
