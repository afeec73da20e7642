"""Pages and REST over TLS, with a certificate of one's own."""

import shutil
import subprocess

import gateways
import httpx
import pytest

from pup.errors import InputError
from services.gateway.config import Config

pytest.importorskip("fastapi")
OPENSSL = shutil.which("openssl")
pytestmark = pytest.mark.skipif(OPENSSL is None, reason="no openssl: apt-get install openssl")
NEW = ("req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-days", "2")
NAMED = ("-subj", "/CN=gateway", "-addext", "subjectAltName=IP:127.0.0.1")


def certified(folder, *more):
    """A certificate and its key."""
    certificate, key = str(folder / "gateway.pem"), str(folder / "gateway.key")
    told = (*NEW, *NAMED, "-out", certificate, "-keyout", key, *more)
    subprocess.run([OPENSSL, *told], check=True, capture_output=True)
    return {"CERTIFICATE": certificate, "KEY": key}


def test_pages_and_streams_come_over_tls_and_the_cookie_over_nothing_else(tmp_path, monkeypatch):
    files = certified(tmp_path, "-nodes")
    monkeypatch.setenv("SSL_CERT_FILE", files["CERTIFICATE"])
    with gateways.running(tmp_path / "data", **files) as service, service.client() as http:
        assert http.get("/v1/studies").json() == {"studies": [], "next": None}
        with http.stream("GET", "/v1/agents/-/events") as stream:
            assert next(stream.iter_lines()) == "retry: 2000"
        entered = http.post("/login", data={"token": service.tokens["viewer"]})
        assert "; Secure" in entered.headers["Set-Cookie"]
        with pytest.raises(httpx.RemoteProtocolError):
            httpx.get(f"http://127.0.0.1:{service.port}/healthz")


def test_a_key_with_a_pass_phrase_is_refused_and_nothing_is_asked(tmp_path):
    """A service has nobody to ask; at a terminal it would ask again with the database taken."""
    from services.gateway import server

    files = certified(tmp_path, "-passout", "pass:secret")
    config = Config(tmp_path / "data", certificate=files["CERTIFICATE"], key=files["KEY"])
    with pytest.raises(InputError, match="is encrypted; give it without a pass phrase"):
        server.serve(config)
    assert not config.data.exists()
