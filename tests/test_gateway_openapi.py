"""The gateway against its own description: requests made from OpenAPI, by schemathesis."""

import subprocess
import sys
from pathlib import Path

import gateways
import httpx
import pytest

CONFIG = """
[checks.negative_data_rejection]
expected-statuses = [400, 401, 403, 404, 405, 406, 409, 413, 415, 422, 428, 429]

[[operations]]  # without a Ray cluster, it says so with 503
include-name = "POST /v1/jobs"
checks.not_a_server_error.enabled = false
checks.negative_data_rejection.expected-statuses = ["4xx", 503]

[[operations]]  # lower and upper of one length: no schema can say that
include-name = "POST /v1/studies"
checks.positive_data_acceptance.expected-statuses = ["2xx", 401, 403, 404, 409, 413, 422, 429]
"""


@pytest.mark.slow
@pytest.mark.parametrize("role", ["operator", "viewer"])
def test_what_the_description_allows_works_and_what_it_does_not_is_refused(
    tmp_path: Path, role: str
) -> None:
    (tmp_path / "schemathesis.toml").write_text(CONFIG)
    with gateways.running(tmp_path / "data") as service:
        with service.client() as http:
            asked = gateways.STUDY | {"name": "known", "trials": 5}
            assert http.post("/v1/studies", json=asked).status_code == 201
        token = service.tokens[role]
        command = [
            *(str(Path(sys.executable).parent / "schemathesis"), "--config-file"),
            *("schemathesis.toml", "run", f"{service.url}/openapi.json", "--seed", "1"),
            *("--header", f"Authorization: Bearer {token}", "--max-examples", "30", "--no-color"),
        ]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=550)
        assert done.returncode == 0, done.stdout[-6000:]
        assert httpx.get(f"{service.url}/readyz").status_code == 200
