"""Settings of a gateway whose secrets lie in files of their own, and these files."""

import logging
import os
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
import zmq.auth
from commandline import pup

from pup.errors import InputError
from services.gateway.config import Config
from services.gateway.keys import KeyRing, Role, Tokens


def test_secrets_lie_in_the_data_folder_unless_told(tmp_path: Path) -> None:
    config = Config.read(None, {"PUP_DATA": str(tmp_path)})
    assert config.token_store.file == tmp_path / "tokens.json"
    assert config.key_ring.folder == tmp_path / "curve"
    assert config.key_ring.agents_folder == tmp_path / "curve/agents"
    assert config.url == f"sqlite:///{tmp_path}/gateway.db"


def test_secrets_lie_where_they_are_told_to(tmp_path: Path) -> None:
    told = {"PUP_TOKENS": "a/t.json", "PUP_CURVE": "b", "PUP_AGENTS": "c"}
    config = Config.read(None, told)
    assert config.token_store.file == Path("a/t.json")
    assert (config.key_ring.folder, config.key_ring.agents_folder) == (Path("b"), Path("c"))
    assert Config.read(None, {"PUP_CURVE": "b"}).key_ring.agents_folder == Path("b/agents")


def test_the_url_of_the_database_may_lie_in_a_file(tmp_path: Path) -> None:
    file = tmp_path / "url"
    file.write_text("postgresql+psycopg://pup:secret@db/pup\n")
    told = {"PUP_DATABASE_FILE": str(file)}
    assert Config.read(None, told).url == "postgresql+psycopg://pup:secret@db/pup"
    assert Config.read(None, told | {"PUP_DATABASE": "sqlite://"}).url == "sqlite://"
    assert Config.read(None, {"PUP_DATABASE_FILE": ""}).database == ""
    with pytest.raises(InputError, match=r"PUP_DATABASE_FILE: .*/none cannot be read"):
        Config.read(None, {"PUP_DATABASE_FILE": str(tmp_path / "none")})


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('data = "~nosuchuser/x"', "data: '~nosuchuser/x' begins with nobody's home folder"),
        ('recordings = "~nosuchuser/x"', "recordings: '~nosuchuser/x' begins with nobody's"),
        ("port = 1.5", "port: '1.5' is none; use 0 to 65535"),
        ("port = 8470.0", "port: '8470.0' is none"),
        ("jobs_at_once = nan", "jobs_at_once: 'nan' is none"),
    ],
)
def test_what_cannot_be_is_told_in_a_line(tmp_path: Path, line: str, words: str) -> None:
    (tmp_path / "gateway.toml").write_text(line)
    done = pup("serve", "token", "ann", "--role", "viewer", "--config", tmp_path / "gateway.toml")
    assert done.code == 2 and words in done.err and len(done.err.splitlines()) == 1


def test_a_path_may_begin_at_home() -> None:
    told = {"PUP_DATA": "~/service", "PUP_RECORDINGS": "~/recordings"}
    config = Config.read(None, told)
    shelves = {"lab": Path.home() / "recordings", "robots": Path.home() / "service/recordings"}
    assert config.shelves == shelves


@pytest.mark.skipif(not os.access("/dev/shm", os.W_OK), reason="needs a second file system")
def test_keys_go_to_another_file_system(tmp_path: Path) -> None:
    """As to a folder that is mounted into the container, for the robot."""
    with TemporaryDirectory(dir="/dev/shm") as folder:
        out = Path(folder)
        assert out.stat().st_dev != tmp_path.stat().st_dev
        done = pup("serve", "agent", "op2-a", "--out", out, "--config", _service(tmp_path))
        assert done.code == 0, done.err
        assert {f.name for f in out.iterdir()} == {"op2-a.key_secret", "gateway.key"}
        public, _ = zmq.auth.load_certificate(out / "op2-a.key_secret")
        ring = KeyRing(tmp_path / "service" / "curve")
        assert ring.agents() == {public: "op2-a"}
        assert zmq.auth.load_certificate(out / "gateway.key")[0] == ring.gateway()[0]


def _service(folder: Path) -> Path:
    file = folder / "gateway.toml"
    file.write_text('data = "service"')
    return file


def test_keys_that_are_let_in_nowhere_can_be_made_again(tmp_path: Path) -> None:
    ring, out = KeyRing(tmp_path / "curve", tmp_path / "agents"), tmp_path / "robot"
    ring.agents_folder.touch()  # a file in the folder's place
    with pytest.raises(OSError, match="exists"):
        ring.create_agent("op2-a", out)
    assert not list(out.glob("*.key_secret"))
    ring.agents_folder.unlink()
    secret, _ = ring.create_agent("op2-a", out)
    assert list(ring.agents().values()) == ["op2-a"] and secret.stat().st_mode & 0o077 == 0
    with pytest.raises(InputError, match="use another folder"):
        ring.create_agent("op2-b", ring.agents_folder)


def test_tokens_that_cannot_be_read_lock_nobody_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    tokens = Tokens(tmp_path / "tokens.json")
    ann = tokens.create("ann", Role.OPERATOR)
    assert tokens.user(ann)
    whole = tokens.file.read_text()
    caplog.set_level(logging.ERROR)
    for broken in ("{", '{"schema": 1, "tokens": {"ann": {"role": "king"}}}'):
        caplog.clear()
        tokens.file.write_text(broken)
        assert all(tokens.user(ann) and not tokens.user("other") for _ in range(3))
        assert len(caplog.records) == 1
    tokens.file.write_text(whole)
    tokens.revoke("ann")
    assert not tokens.user(ann)
    bob = tokens.create("bob", Role.VIEWER)
    assert tokens.user(bob)
    tokens.file.rename(tmp_path / "away")
    assert not tokens.user(bob)
    (tmp_path / "away").rename(tokens.file)
    assert tokens.user(bob)
