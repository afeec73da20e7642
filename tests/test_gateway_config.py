"""Settings of a gateway whose secrets lie in files of their own."""

from pathlib import Path

import pytest

from pup.errors import InputError
from services.gateway.config import Config


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
