"""`agent.toml`: every mistake is told in one line, and `pup-agent` exits with 2."""

import os
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import pytest
from agents import CONFIG, DARWIN, changed

from hardware_agent.body import Body
from hardware_agent.cli import main
from hardware_agent.config import SafetySettings, Settings, check_together
from hardware_agent.control import ControlServer
from hardware_agent.journal import Journal
from pup.errors import InputError

WHOLE = CONFIG.format(folder="/tmp/nowhere", protocol=1, clock="wall")


def read(folder: Path, text: str) -> Settings:
    file = folder / "agent.toml"
    file.write_text(text)
    return Settings.read(file)


def test_a_configuration_is_read_and_the_rest_has_defaults(tmp_path: Path) -> None:
    settings = read(tmp_path, WHOLE)
    assert settings.bus.baud == 1_000_000 and settings.bus.gains is None
    assert settings.state == tmp_path / "state"
    assert settings.control.rate == 33.0 and settings.safety.temperature == 70.0


def test_defaults_may_be_written_down(tmp_path: Path) -> None:
    """None of them is beyond its range."""
    told = {f.name: f.default for f in fields(SafetySettings) if f.default is not None}
    text = "".join(f"{key} = {list(v) if isinstance(v, tuple) else v}\n" for key, v in told.items())
    assert read(tmp_path, changed(WHOLE, f"[safety]\n{text}")).safety == SafetySettings()


MISTAKES = {
    "an unknown key": (
        "[bus]\nbaudrate = 1",
        "bus.baudrate: unknown key",
    ),
    "an unknown table": ("[motors]\nx = 1", "motors: unknown key"),
    "a text for a number": ('[bus]\nbaud = "fast"', "bus.baud: expected a whole number"),
    "another protocol": ("[bus]\nprotocol = 3", "bus.protocol: 3; use one of 1, 2"),
    "sync read with 1.0": ('[bus]\nread = "sync"', "Protocol 1.0 has read"),
    "rotating sync read": (
        '[bus]\nprotocol = 2\nread = "sync"\ndetail = "rotating"',
        "bus.detail: a sync read",
    ),
    "two gains": ("[bus]\ngains = [32, 16]", "bus.gains: write P, I and D"),
    "a gain too large": ("[bus]\ngains = [850, 0, 0]", "bus.gains: write P, I and D"),
    "half a gain": ("[bus]\ngains = [32.5, 0, 16]", "bus.gains: expected whole numbers"),
    "a half turn": ("[bus.joints.l_knee]\nsign = 0", "bus.joints.l_knee.sign: 0; use one of 1, -1"),
    "a sign in words": ('[bus.joints.l_knee]\nsign = "-"', "l_knee.sign: expected a whole number"),
    "a zero beyond the servo": (
        "[bus.joints.l_knee]\nzero = 4096",
        "bus.joints.l_knee.zero: 4096 is outside [0, 4095]",
    ),
    "an angle as a zero": ("[bus.joints.l_knee]\nzero = 0.1", "zero: expected a whole number"),
    "another key of a joint": ("[bus.joints.l_knee]\nid = 3", "bus.joints.l_knee.id: unknown key"),
    "joints in a row": ("[bus]\njoints = 3", "bus.joints: expected a table"),
    "an IMU nowhere": ('[imu]\nport = ""', "imu.port: missing"),
    "an axis twice": ('[imu]\naxes = ["x", "x", "z"]', "imu.axes: names an axis twice"),
    "a mirrored IMU": ('[imu]\naxes = ["y", "x", "z"]', "imu.axes: is a mirror image"),
    "an angle of the IMU": ('[imu]\nroll = "-roll"', "imu.roll: no longer a setting; imu.axes"),
    "a rate of nothing": ("[control]\nrate = 0", "control.rate: 0 is outside"),
    "a text for true": ('[control]\nrealtime = "no"', "control.realtime: expected true or false"),
    "a limit too hot": ("[safety]\ntemperature = 95", "safety.temperature: 95 is outside"),
    "no voltage": ("[safety]\nvoltage = [15, 9]", "safety.voltage: write [least, largest]"),
    "a voltage in mV": ("[safety]\nvoltage = [9500, 15000]", "largest], from 5 to 20 V"),
    "an age in ms": ("[safety]\nstale = 20", "safety.stale: 20 is outside [0.001, 1]"),
    "a delay in ms": ("[safety]\nlate = 150", "safety.late: 150 is outside [0.001, 2]"),
    "a tilt in degrees": ("[safety]\nfall_tilt = 60", "safety.fall_tilt: 60 is outside [0.1, 1.6]"),
    "a lean in degrees": ("[control]\nupright = 15", "control.upright: 15 is outside [0.01, 1.6]"),
    "all of the current": ("[safety]\ncurrent = 1.0", "safety.current: 1 is outside [0.01, 0.95]"),
    "a time that stands still": (
        '[control]\nclock = "lockstep"\nsource = "hardware"',
        'control.clock: a real robot\'s time does not stand still; "lockstep" needs source',
    ),
    "no hook": ('[distance]\nkind = "hook"', "distance.command: missing"),
    "a port that is none": (
        '[link]\nkey = "a"\ngateway_key = "b"\ngateway = "tcp://a:84711"',
        "link.gateway: 'tcp://a:84711'; write tcp://HOST:PORT",
    ),
    "an address of a page": (
        '[link]\nkey = "a"\ngateway_key = "b"\ngateway = "tcp://a/v1:8471"',
        "link.gateway: 'tcp://a/v1:8471'; write tcp://HOST:PORT",
    ),
    "a gateway without keys": ('[link]\ngateway = "tcp://a:1"', "link.key: missing"),
    "an odd gateway": (
        '[link]\nkey = "a"\ngateway_key = "b"\ngateway = "http://a"',
        "link.gateway: 'http://a'; write tcp://HOST:PORT",
    ),
}


@pytest.mark.parametrize(("more", "told"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_is_told_in_one_line(tmp_path: Path, more: str, told: str) -> None:
    with pytest.raises(InputError) as refused:
        read(tmp_path, changed(WHOLE, more))
    assert told in str(refused.value) and "\n" not in str(refused.value)
    assert "agent.toml" in str(refused.value)


@pytest.mark.parametrize(
    ("place", "told"),
    [("~nobody-here/x", "there is no such user here"), ("a\\u0000b", "no path has a zero in it")],
)
def test_a_path_that_leads_nowhere_is_told_and_does_not_keep_a_stop_from_being_tried(
    tmp_path: Path, place: str, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for key in ("state", "policies", "socket"):
        text = WHOLE.replace(f'{key} = "', f'{key} = "{place}', 1)
        with pytest.raises(InputError, match=f"agent.toml: {key}: .*{told}"):
            read(tmp_path, text)
        assert main(["stop", "--config", str(tmp_path / "agent.toml")]) == 2
        assert "no servo was told anything: use the power switch" in capsys.readouterr().err


def test_a_rate_that_the_limits_do_not_allow_is_refused(tmp_path: Path) -> None:
    """Else the robot would be stopped, or its agent killed, as soon as it is enabled."""
    for more, told in (
        ("[control]\nrate = 5\n[safety]\nlate = 0.15", "safety.late: at 5 Hz"),
        ("[control]\nrate = 10\n[watchdog]\ntimeout = 0.1", "watchdog.timeout: at 10 Hz"),
    ):
        settings = read(tmp_path, changed(WHOLE, more))
        with pytest.raises(InputError, match=told):
            check_together(settings, tmp_path / "agent.toml")
    check_together(read(tmp_path, WHOLE), tmp_path / "agent.toml")


def test_a_board_with_the_id_of_a_servo_is_refused(tmp_path: Path) -> None:
    """What makes a board give its servos current is what makes a servo hold."""
    with pytest.raises(InputError, match=r"bus.board: 20 is the servo of head_tilt; a CM-740"):
        Body(read(tmp_path, changed(WHOLE, "[bus]\nboard = 20")), DARWIN)
    Body(read(tmp_path, changed(WHOLE, "[bus]\nboard = 0")), DARWIN)


def test_an_imu_on_the_port_of_the_servos_is_refused(tmp_path: Path) -> None:
    settings = read(tmp_path, WHOLE)
    together = replace(settings, imu=replace(settings.imu, port=settings.bus.port))
    with pytest.raises(InputError, match=r"imu\.port: is that of the servo bus"):
        check_together(together, tmp_path / "agent.toml")


def test_a_file_in_the_sockets_place_is_left_alone(tmp_path: Path) -> None:
    mine = tmp_path / "journal"
    mine.write_text("mine")
    with pytest.raises(InputError, match="no socket can be made there"):
        ControlServer(mine, lambda _: {}, lambda: None)
    assert mine.read_text() == "mine"


@pytest.mark.parametrize("verb", ["run", "enable", "health", "disable", "stop"])
def test_every_verb_refuses_it_with_2(
    tmp_path: Path, verb: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "agent.toml"
    file.write_text(WHOLE.replace("schema = 1", "schema = 9"))
    assert main([verb, "--config", str(file)]) == 2
    assert main([verb, "--config", str(tmp_path / "none.toml")]) == 2
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 2 and all(line.startswith(f"pup-agent {verb}: ") for line in told)


def test_nobody_listening_is_unhealthy_and_not_a_mistake(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "agent.toml").write_text(WHOLE)
    assert main(["health", "--config", str(tmp_path / "agent.toml")]) == 1
    assert "no agent answers" in capsys.readouterr().err


def test_keys_are_made_once_and_secret(tmp_path: Path) -> None:
    assert main(["keys", "op2", "--out", str(tmp_path / "keys")]) == 0
    assert main(["keys", "op2", "--out", str(tmp_path / "keys")]) == 2
    assert main(["keys", "../op3", "--out", str(tmp_path / "keys")]) == 2
    assert not (tmp_path / "op3.key").exists()
    (tmp_path / "file").touch()
    assert main(["keys", "op2", "--out", str(tmp_path / "file")]) == 2
    with pytest.raises(InputError, match="file/journal: cannot be written"):
        Journal(tmp_path / "file" / "journal")
    assert (tmp_path / "keys" / "op2.key_secret").stat().st_mode & 0o077 == 0


def test_help_tells_of_the_variable_and_it_is_heeded(tmp_path: Path) -> None:
    """A process of its own: the variable is read where one starts."""
    file = tmp_path / "100%.toml"
    file.write_text(WHOLE.replace("schema = 1", "schema = 9"))

    def told(*arguments: str) -> tuple[int, str]:
        done = subprocess.run(
            [sys.executable, "-m", "hardware_agent.cli", *arguments],
            env=os.environ | {"PUP_AGENT_CONFIG": str(file), "COLUMNS": "300"},
            capture_output=True,
            text=True,
            timeout=100,
        )
        return done.returncode, done.stdout + done.stderr

    assert told("health")[0] == 2 and str(file) in told("health")[1]
    for asked in (["--help"], ["health", "--help"]):
        code, text = told(*asked)
        assert code == 0 and "PUP_AGENT_CONFIG" in text and "/etc/pup-agent/agent.toml" in text
    assert f"now {file}" in text
