"""The pages of what was found, in a real headless Chromium: on a desk, on a phone, by keyboard."""

import gateways
import httpx
import pages
import pytest
import stored_findings

pytest.importorskip("fastapi")
pytest.importorskip("botorch")

RECORDINGS = "/recordings/lab"
PATHS = (
    "/",
    "/recordings",
    f"{RECORDINGS}/standup_1.75.parquet",
    f"{RECORDINGS}/bench/currents.parquet",
    f"{RECORDINGS}/torn.parquet",
    "/recordings/robots/op-1/walk_7.parquet",
    "/bounds",
    *(f"/bounds/job-{name}" for name in ("fit", "mission", "torn", "begun")),
    "/training",
    *(f"/training/job-{name}" for name in ("walker", "learner", "fit")),
    "/diagnoses",
    "/diagnoses/job-sick",
    "/diagnoses/job-fit",
    "/jobs/job-mission",
    "/studies",
    "/agents",
)
SHUT = (
    f"{RECORDINGS}/link.parquet",
    f"{RECORDINGS}/none.parquet",
    f"{RECORDINGS}/..%2f..%2fdata%2fsecret.parquet",
    f"{RECORDINGS}/%2e%2e/%2e%2e/data/secret.parquet",
    f"{RECORDINGS}/{'x' * 300}.parquet",
    "/recordings/other/standup_1.75.parquet",
    "/recordings/robots/..%2fsecret.parquet",
    "/reports/job-fit/..%2forder.json",
    "/reports/job-fit/none.html",
    "/reports/job-none/report.html",
    "/bounds/job-none",
    "/training/..%2f..",
)
pytestmark = pages.NEEDED


@pytest.fixture(scope="module")
def lab(tmp_path_factory, bench_recordings):
    return stored_findings.keep(tmp_path_factory.mktemp("lab"), bench_recordings)


@pytest.fixture(scope="module")
def service(lab):
    away = f"http://127.0.0.1:{gateways.free_port()}"
    told = {"RAY": away, "SHARED": str(lab.shared), "RECORDINGS": str(lab.recordings)}
    with gateways.running(lab.data, **told) as made:
        yield made


@pytest.mark.parametrize("size", pages.SIZES)
def test_every_page_fits_and_is_accessible(open_page, size):
    page = open_page(viewport=pages.SIZES[size])
    for path in PATHS:
        pages.check(page, path, size)


def test_the_first_page_leads_to_all_by_keyboard(open_page):
    page = open_page("viewer")
    tiles = page.locator("main section")
    assert tiles.count() == 7
    assert "14 of darwin_op2" in tiles.nth(0).inner_text()
    for name in ("Recordings", "Bounds", "Training", "Studies", "Diagnoses", "Jobs", "Agents"):
        page.goto("/")
        link = page.locator("main").get_by_role("link", name=name)
        for _ in range(30):
            page.keyboard.press("Tab")
            if link.evaluate("link => link === document.activeElement"):
                break
        page.keyboard.press("Enter")
        page.get_by_role("heading", level=1, name=name).wait_for()
        assert page.locator("nav [aria-current=page]").inner_text() == name


def test_recordings_are_listed_and_drawn(open_page):
    page = open_page()
    page.goto("/recordings")
    row = page.get_by_role("row").filter(has_text="standup_1.75")
    assert row.get_by_role("cell").all_inner_texts()[1:5] == [
        *("darwin_op2", "standup", "ground", "simulation"),
    ]
    page.get_by_text("not a readable Parquet file").wait_for()
    row.get_by_role("link").click()
    page.get_by_role("img", name="command and position of l_knee").wait_for()
    assert page.locator("svg").count() == 20
    page.goto(f"{RECORDINGS}/bench/currents.parquet")
    assert page.get_by_role("img", name="current of servo").locator(".current").count() == 1
    page.get_by_text(stored_findings.SCRIPT).wait_for()
    assert page.title() == "pup: bench/currents"
    page.goto(f"{RECORDINGS}/torn.parquet")
    page.get_by_text("It cannot be shown: not a readable Parquet file").wait_for()


def test_bounds_lead_to_their_report(open_page):
    page = open_page()
    page.goto("/bounds")
    page.get_by_text("cannot be shown: Invalid JSON").wait_for()
    page.get_by_text("nothing is written yet").wait_for()
    page.get_by_role("link", name="job-fit").click()
    page.wait_for_url("**/bounds/job-fit")
    rows = page.locator("tbody tr")
    pictures = page.locator("svg.range")
    assert rows.count() == pictures.count() > 2
    assert rows.first.get_by_text("identified").count() == 1
    assert "searched from" in pictures.first.get_attribute("aria-label")
    page.get_by_role("link", name="The whole report").click()
    page.wait_for_url("**/reports/job-fit/report.html")
    assert page.locator("h1").count() == 1 and page.locator("img").count() > 0
    shown = page.locator("img").first.evaluate("image => image.complete && image.naturalWidth")
    assert shown, "a picture of the report is not shown"


def test_a_report_can_do_nothing(browser, service):
    """One that somebody put there runs no script and posts no form; its links work."""
    with pages.opener(browser, service, lambda message: False) as opened:
        page = opened()
        page.goto("/jobs/job-mission")
        page.locator("#live").get_by_role("link", name="report", exact=True).click()
        page.get_by_role("heading", name="Job").wait_for()
        assert page.title() == "mission"
        with page.expect_download() as download:
            page.locator("#file").click()
        assert download.value.suggested_filename == "run.json"
        page.locator("#stage").click()
        page.wait_for_url("**/reports/job-mission/presysid/report.html")
        page.get_by_role("heading", level=1).wait_for()


def test_a_curve_grows_while_it_is_looked_at(open_page, lab):
    page = open_page()
    page.goto("/training/job-learner")
    page.get_by_text("0.02 of 1 M steps").wait_for()
    assert page.locator("polyline.mean").count() == 3
    page.get_by_role("img", name="Distance of an episode, now 0.155 m").wait_for()
    stored_findings.grow(lab, 40)
    page.get_by_text("0.04 of 1 M steps").wait_for()
    page.get_by_role("img", name="Distance of an episode, now 0.355 m").wait_for()
    page.goto("/training")
    page.get_by_role("row").filter(has_text="job-mission train").wait_for()


def test_diagnoses_tell_verdict_and_probabilities(open_page):
    page = open_page()
    page.goto("/diagnoses")
    page.get_by_role(
        "heading", name="servo_bench: The simulator lacks backlash at joint servo."
    ).wait_for()
    page.get_by_role("row").filter(has_text="backlash").get_by_text("90 %").wait_for()
    page.get_by_role("heading", name="These recordings cannot tell").wait_for()
    page.get_by_role("link", name="The whole report").first.click()
    page.get_by_role("heading", level=1).wait_for()
    assert "/reports/job-s" in page.url


@pytest.mark.parametrize("path", SHUT)
def test_there_is_no_way_out(service, path):
    with service.client() as http:
        answer = http.get(path)
    assert answer.status_code == 404, answer.text


def test_all_is_for_those_who_may_come_in(service):
    for path in (*PATHS, *SHUT, "/reports/job-fit/report.html"):
        answer = httpx.get(f"{service.url}{path}")
        assert answer.status_code in (303, 404), path
        assert answer.headers.get("location", "/login") == "/login"
    with service.client("viewer") as http:
        for path in PATHS:
            assert http.get(path).status_code == 200, path
        policy = http.get("/reports/job-fit/report.html").headers.get_list(
            "content-security-policy"
        )
    assert len(policy) == 1 and policy[0].startswith("sandbox ") and "script" not in policy[0]
    assert "default-src 'none'; img-src data:;" in policy[0]
