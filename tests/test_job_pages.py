"""The pages of jobs in a real headless Chromium: states, log, artefacts, buttons, on a phone."""

from pathlib import Path

import gateways
import pages
import pytest
import stored_jobs

pytest.importorskip("fastapi")
pytest.importorskip("botorch")

PATHS = ("/jobs", *(f"/jobs/{job.id}" for job in stored_jobs.ALL))
pytestmark = pages.NEEDED


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pages")
    shared = folder / "shared"
    stored_jobs.keep(folder / "data", shared)
    away = f"http://127.0.0.1:{gateways.free_port()}"
    with gateways.running(folder / "data", RAY=away, SHARED=str(shared)) as made:
        yield made


@pytest.mark.parametrize("size", pages.SIZES)
def test_every_page_fits_and_is_accessible(open_page, size):
    page = open_page(viewport=pages.SIZES[size])
    for path in PATHS:
        pages.check(page, path, size)


def test_a_job_is_told_with_its_log_and_files(open_page):
    page = open_page()
    page.get_by_role("navigation").get_by_role("link", name="Jobs").click()
    page.get_by_text("Jobs wait for the Ray cluster, which does not answer").wait_for()
    assert page.locator("tbody tr").count() == len(stored_jobs.ALL)
    page.get_by_role("link", name="job-done").click()
    page.get_by_text("generation 3 of 100").wait_for()
    with page.expect_download() as download:
        page.get_by_role("link", name="checkpoints/fit 1%.npz").click()
    assert Path(download.value.path()).read_bytes() == bytes(range(256)) * 1000
    assert page.get_by_role("link", name="bounds.json").count() == 1
    assert page.get_by_text("half").count() + page.get_by_text("link", exact=True).count() == 0


def test_what_others_say_is_text(open_page):
    page = open_page()
    page.goto("/jobs/job-failed")
    page.get_by_text("<script>alert(1)</script>").first.wait_for()


def test_buttons_are_for_those_who_may(open_page):
    page, viewer, admin = open_page(), open_page("viewer"), open_page("admin")
    for one, path, count in (
        (page, "/jobs/job-running", 1),
        (page, "/jobs/job-other", 0),
        (viewer, "/jobs/job-running", 0),
        (admin, "/jobs/job-other", 1),
        (page, "/jobs/job-done", 0),
    ):
        one.goto(path)
        one.locator("h1").wait_for()
        assert one.get_by_role("button", name="Cancel").count() == count, path
    page.goto("/jobs/job-lost")
    page.get_by_role("button", name="Try again").click()
    page.get_by_text("queued", exact=True).wait_for()
    page.goto("/jobs/job-running")
    page.get_by_role("button", name="Cancel").click()
    page.get_by_text("cancelling", exact=True).wait_for()
