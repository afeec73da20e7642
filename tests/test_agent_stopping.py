"""The emergency stop at the robot's computer: it needs no faultless configuration, and no agent."""

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from agents import CONFIG, lab, wait
from test_agent import IDS
from test_agent_holds import enabled

from hardware_agent import stopping
from hardware_agent.bus import Bus
from hardware_agent.cli import main
from hardware_agent.config import BusSettings
from hardware_agent.control import ControlServer
from pup.errors import InputError

WHOLE = CONFIG.format(folder="/tmp/nowhere", protocol=1, clock="wall")
MISTAKES = {
    "an unknown key": WHOLE.replace("[bus]", "[bus]\nbuad = 1"),
    "no TOML": WHOLE.replace("[bus]", "[bus"),
    "a quote that lacks": WHOLE.replace('state = "state"', 'state = "state'),
}


@pytest.fixture
def heard(tmp_path: Path) -> Iterator[list[dict[str, Any]]]:
    """What an agent hears that listens at the configuration's socket."""
    told: list[dict[str, Any]] = []

    def answer(command: dict[str, Any]) -> dict[str, Any]:
        told.append(command)
        return {"limp": True}

    server = ControlServer(tmp_path / "agent.sock", answer, lambda: None)
    server.start()
    yield told
    server.close()


def said(capsys: pytest.CaptureFixture[str]) -> str:
    (line,) = capsys.readouterr().err.splitlines()
    return line


@pytest.mark.parametrize("verb", ["stop", "disable"])
@pytest.mark.parametrize("text", MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_in_the_configuration_does_not_keep_it_from_the_agent(
    tmp_path: Path,
    heard: list[dict[str, Any]],
    text: str,
    verb: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "agent.toml").write_text(text)
    assert main([verb, "--config", str(tmp_path / "agent.toml")]) == 0
    assert heard == [{"do": verb}]
    assert f"pup-agent {verb}: the agent at {tmp_path}/agent.sock was told; " in said(capsys)


def test_a_configuration_that_is_not_there_leaves_the_usual_socket(
    tmp_path: Path,
    heard: list[dict[str, Any]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(stopping, "SOCKET", tmp_path / "agent.sock")
    assert main(["stop", "--config", str(tmp_path / "none.toml")]) == 0
    assert heard == [{"do": "stop"}] and "none.toml" in said(capsys)


def test_with_neither_agent_nor_configuration_it_says_that_nothing_was_done(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "agent.toml").write_text(MISTAKES["an unknown key"])
    assert main(["stop", "--config", str(tmp_path / "agent.toml")]) == 2
    told = said(capsys)
    assert "bus.buad: unknown key" in told and "no servo was told anything: use the power" in told


def test_without_an_agent_it_takes_the_bus(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("mujoco")
    with lab(tmp_path) as made:
        made.start()
        made.say("enable")
        made.until("enabled")
        made.end()
        assert main(["stop", "--config", str(made.config)]) == 0
        assert "torque was turned off over" in said(capsys)
        made.side(cmd="fault", kind="bus_pulled")
        assert main(["stop", "--config", str(made.config)]) == 1
        assert "no servo at" in said(capsys)
        made.side(cmd="fault", kind="bus_pulled", off=True)
        other = Bus(BusSettings(str(tmp_path / "bus")), IDS)  # as the watchdog's process does
        other.take()
        threading.Timer(0.5, other.close).start()
        assert main(["stop", "--config", str(made.config)]) == 0
        assert "torque was turned off over" in said(capsys)
        made.side(cmd="fault", kind="port_pulled")
        wait(lambda: not (tmp_path / "bus").exists(), 10)
        assert main(["stop", "--config", str(made.config)]) == 1
        assert "no servo was told anything" in said(capsys)


def test_a_switch_that_is_pressed_keeps_the_robot_from_being_enabled(tmp_path: Path) -> None:
    """A latched one gives no edge to wait for: the command looks at its level first."""
    pytest.importorskip("mujoco")
    released = tmp_path / "released"
    script = f"while test -e {released}; do sleep 0.05; done"
    with lab(tmp_path, more=f'[stop]\ncommand = ["sh", "-c", "{script}"]\n') as made:
        made.start()
        for _ in range(2):
            with pytest.raises(InputError, match="ended at once, with 0; release the emergency"):
                made.say("enable")
        assert made.side(cmd="bus")["holding"] == 0
        released.touch()
        enabled(made)
        released.unlink()
        assert "command has ended" in made.until("stopped")["reason"]
