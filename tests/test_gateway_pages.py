"""The pages in a real headless Chromium: a study as it goes on, the gate, agents, on a phone."""

import signal

import fake_agent
import gateways
import pages
import pytest

pytest.importorskip("fastapi")
pytest.importorskip("botorch")

pytestmark = pages.NEEDED


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    with gateways.running(tmp_path_factory.mktemp("pages") / "data") as made:
        yield made


@pytest.fixture(scope="module")
def browser():
    with pages.chromium() as made:
        yield made


@pytest.fixture
def open_page(browser, service):  # whose answers may be errors: some tests provoke them
    with pages.opener(browser, service, lambda m: "Security Policy" in m.text) as opened:
        yield opened


def test_without_a_token_there_is_the_way_in(open_page):
    page = open_page(role=None)
    page.goto("/studies/any")
    assert page.url.endswith("/login")
    page.get_by_label("Token").fill("wrong")
    page.get_by_role("button", name="Enter").click()
    page.get_by_text("not known").wait_for()
    pages.shot(page, "login")


def test_an_operator_leads_a_study_to_its_end(open_page, service):
    keys = service.agent_keys("page-1")
    walk = fake_agent.walks(lambda eta: 0.8 - 0.2 * sum((x - 0.3) ** 2 for x in eta))
    asked = gateways.STUDY | {"name": "stroll", "gate": "operator", "trials": 7, "repeats": 1}
    page = open_page()
    page.goto("/studies")
    page.get_by_text("No study yet").wait_for()
    with service.client() as http, fake_agent.FakeAgent(*keys, service.link, walk, pause=0.3):
        http.post("/v1/studies", json=asked | {"initial": 6})
        page.reload()
        page.get_by_role("link", name="stroll").click()
        for number in range(1, 9):
            page.get_by_role("button", name=f"Release trial {number}", exact=True).click()
            if number == 8:
                pages.shot(page, "study")
        page.get_by_text("done", exact=True).first.wait_for()
        assert page.locator("svg").count() == 4
        assert page.locator("polygon.band").count() == 3
        assert page.locator("tbody tr").count() == 8
        assert page.get_by_role("button", name="Release").count() == 0
        pages.shot(page, "study_done")
        page.get_by_role("link", name="Studies").click()
        page.get_by_text("7 of 7").wait_for()
        pages.shot(page, "studies")
        page.get_by_role("link", name="Agents").click()
        page.get_by_text("41.5").wait_for()
        pages.shot(page, "agents")
        phone = open_page(viewport=pages.PHONE, has_touch=True, is_mobile=True)
        for path in ("/studies", "/studies/stroll", "/agents"):
            pages.check(phone, path, "phone")


def test_a_viewer_has_no_buttons_and_a_stop_stops(open_page, service):
    keys = service.agent_keys("page-2")
    asked = gateways.STUDY | {"name": "halt", "agent": "page-2", "trials": 2, "initial": 2}
    walk = lambda body: None  # noqa: E731 - a walk that does not end
    with service.client() as http, fake_agent.FakeAgent(*keys, service.link, walk) as agent:
        http.post("/v1/studies", json=asked)
        page, viewer = open_page(), open_page("viewer")
        for one in (page, viewer):
            one.goto("/studies/halt")
            one.get_by_text("0.10 m").wait_for()
        assert viewer.get_by_role("button", name="STOP").count() == 0
        assert viewer.get_by_role("button", name="Cancel").count() == 0
        pages.shot(page, "study_running")
        page.get_by_role("button", name="STOP page-2").click()
        page.get_by_text("was stopped by operator").wait_for()
        assert agent.state == "stopped"


def test_a_robot_that_falls_silent_is_shown_so(open_page, service):
    """Though nothing comes from it any more that could tell the page to change."""
    keys = service.agent_keys("page-4")
    asked = gateways.STUDY | {"name": "silent", "agent": "page-4", "trials": 1, "initial": 1}
    with service.client() as http, fake_agent.FakeAgent(*keys, service.link, lambda _: None):
        http.post("/v1/studies", json=asked)
        page, robots = open_page(), open_page()
        page.goto("/studies/silent")
        page.get_by_text("running").first.wait_for()
        robots.goto("/agents")
        robots.locator("section", has_text="page-4").get_by_text("enabled").wait_for()
    page.get_by_text("which was not heard for").wait_for()
    robots.locator("section", has_text="page-4").get_by_text("away").wait_for()
    pages.shot(page, "silent")


def test_names_are_text_and_nothing_else(open_page, service):
    """What others say ends up on pages as text, which fits on a phone however long it is."""
    name = "page-3" + "x" * 57
    keys = service.agent_keys(name)

    def walk(body):
        return fake_agent.Finished(
            body.trial,
            body.attempt,
            body.fence,
            fake_agent.Outcome.ABORTED,
            reason="<script>document.title='taken'</script><img src=x onerror=alert(1)>" + "x" * 90,
        )

    asked = gateways.STUDY | {"name": "text", "agent": name, "failures": 1}
    with service.client() as http, fake_agent.FakeAgent(*keys, service.link, walk):
        http.post("/v1/studies", json=asked)
        service.wait_for("text", "paused")
        page = open_page()
        page.goto("/studies/text")
        page.get_by_text("<script>document").first.wait_for()
        assert page.title() == "pup: text" and page.locator("img").count() == 0
        page.get_by_role("button", name="Retry").wait_for()
        pages.shot(page, "study_paused")
        phone = open_page(viewport=pages.PHONE, has_touch=True, is_mobile=True)
        for path in ("/studies", "/studies/text", "/agents"):
            pages.check(phone, path, "phone")


def test_a_change_of_the_page_takes_no_button_from_under_a_finger(open_page, service):
    """Nor the focus: an agent's card changes with each of its heartbeats."""
    keys = service.agent_keys("page-5")
    with fake_agent.FakeAgent(*keys, service.link, lambda _: None) as agent:
        page = open_page()
        page.goto("/agents")
        button = page.get_by_role("button", name="STOP page-5")
        button.focus()
        button.hover()
        page.mouse.down()
        for _ in range(2):
            page.wait_for_event("response", lambda r: r.url.endswith("/agents/live"))
        assert button.evaluate("button => button === document.activeElement")
        with page.expect_response("**/page-5:stop"):
            page.mouse.up()
        page.get_by_text("Was stopped (operator").first.wait_for()
        assert agent.state == "stopped"


def test_a_stream_that_a_proxy_refused_is_asked_for_again(open_page):
    """As after the 502 of one whose gateway is being started: a browser gives such a stream up."""
    page = open_page()
    page.route("**/events", lambda route: route.fulfill(status=502))
    page.goto("/agents")
    page.get_by_text("does not answer").first.wait_for()
    page.unroute("**/events")
    page.locator("#away").wait_for(state="hidden")


def test_a_stream_that_begins_anew_brings_what_is_new(open_page):
    """Another gateway counts from 0: the number that it begins with tells nothing."""
    page = open_page()
    body = "retry: 50\ndata: 7\n\n"
    page.route(
        "**/events", lambda route: route.fulfill(body=body, content_type="text/event-stream")
    )
    page.goto("/agents", wait_until="commit")
    for _ in range(3):
        page.wait_for_event("response", lambda r: r.url.endswith("/agents/live"))


def test_the_gate_can_be_read_in_the_dark(open_page, service):
    with service.client() as http:
        http.post("/v1/studies", json=gateways.STUDY | {"name": "dark", "gate": "operator"})
    page = open_page(color_scheme="dark")
    page.goto("/studies/dark")
    page.get_by_role("button", name="Release trial 1").wait_for()
    for kind in ("go", "plain"):
        assert pages.contrast(page.locator(f"button.{kind}")) >= 4.5


def test_a_gateway_that_is_away_is_told_and_comes_back(open_page, service):
    with service.client() as http:
        http.post("/v1/studies", json=gateways.STUDY | {"name": "away", "gate": "operator"})
    page = open_page()
    page.goto("/studies/away")
    page.get_by_role("button", name="Release trial 1").wait_for()
    service.kill(signal.SIGKILL)
    page.get_by_text("does not answer").first.wait_for()
    page.get_by_role("button", name="Pause").click()
    page.get_by_text("may or may not have been done").wait_for()
    pages.shot(page, "away")
    service.start()
    page.locator("#away").wait_for(state="hidden")
    page.get_by_role("button", name="Pause").click()
    page.get_by_text("paused", exact=True).wait_for()
