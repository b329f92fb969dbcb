"""The page in headless Chromium, where there is one: no package of the index brings it along."""

import shutil

import pytest

from drake_safety.evaluation.report.page import write_report
from drake_safety.evaluation.report.run_folder import read_run
from report_runs import MODES, write_run

sync_api = pytest.importorskip("playwright.sync_api")
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
CHROMIUM = next(filter(None, map(shutil.which, NAMES)), None)

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason=f"no browser on the path: none of {NAMES}"),
]


@pytest.fixture(scope="module")
def page_file(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "lip"
    folder.mkdir()
    write_run(folder)
    run = read_run(
        folder,
        episodes=folder / "episodes",
        assessments={mode: folder / f"{mode}.safetensors" for mode in MODES},
    )
    return write_report(run, versions={})


@pytest.fixture(scope="module")
def browser():
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def page(browser, page_file):
    """The page, opened without a network; whatever it complains of is kept."""
    context = browser.new_context(offline=True, color_scheme="light")
    page = context.new_page()
    page.complaints = []
    page.on("pageerror", lambda error: page.complaints.append(str(error)))
    page.on("console", lambda message: page.complaints.append(message.text))
    page.on("requestfailed", lambda request: page.complaints.append(request.url))
    page.goto(page_file.as_uri())
    yield page
    assert page.complaints == []
    context.close()


def cells(page):
    return page.locator("article.map:visible rect.cell")


def test_pointing_at_a_cell_shows_its_belief_count_causes_and_a_typical_episode(page):
    filled = page.evaluate(
        """() => {
          const map = JSON.parse(document.querySelector(".map-content").textContent);
          const i = map.cells.findIndex((c) => c.belief[1] > 0.1 && c.belief[2] < 1 && c.typical);
          return [i, map.cells[i].count, Math.round(100 * map.cells[i].belief[1])];
        }"""
    )
    index, count, unsafe = filled
    cells(page).nth(index).hover()
    detail = page.locator("article.map:visible .detail")
    text = detail.inner_text()
    assert f"Learned from {count} segment" in text
    assert f"unsafe {unsafe} %" in text
    assert "support" in text
    assert "Episode" in text
    assert detail.locator("svg.plot polyline").count() == 2


def test_arrow_keys_go_from_cell_to_cell_and_stop_at_the_edge(page):
    cells(page).nth(0).focus()
    detail = page.locator("article.map:visible .detail h4")
    for key, expected in (
        ("ArrowRight", "Cell 2, 1"),
        ("ArrowUp", "Cell 2, 2"),
        ("ArrowLeft", "Cell 1, 2"),
        ("ArrowLeft", "Cell 1, 2"),
    ):
        page.keyboard.press(key)
        assert detail.inner_text() == expected


def test_the_map_changes_its_colours_and_its_mode(page):
    before = [cell.get_attribute("fill") for cell in cells(page).all()[:196]]
    page.locator("article.map:visible select.view").select_option("unknown")
    after = [cell.get_attribute("fill") for cell in cells(page).all()[:196]]
    assert before != after
    page.locator("article.map:visible select.mode").select_option("paper")
    assert page.locator("article.map:visible").get_attribute("data-mode") == "paper"
    assert page.locator("article.map:visible").count() == 1


def test_the_recording_opens_only_when_asked_for(page):
    assert page.locator("iframe").count() == 0
    page.locator(".recording button").click()
    assert page.frame_locator("iframe").locator("#robot").inner_text() == "A robot"


def test_the_page_is_dark_or_light_as_one_prefers_and_white_on_paper(page):
    def ground():
        return page.evaluate("getComputedStyle(document.body).backgroundColor")

    assert ground() == "rgb(255, 255, 255)"
    page.emulate_media(color_scheme="dark")
    assert ground() == "rgb(20, 23, 27)"
    page.emulate_media(media="print", color_scheme="dark")
    assert ground() == "rgb(255, 255, 255)"
    assert page.locator("article.map:visible").count() == 2
    assert not page.locator(".recording").is_visible()


@pytest.mark.parametrize("width", [380, 1280])
def test_nothing_is_wider_than_the_window(page, width):
    page.set_viewport_size({"width": width, "height": 800})
    assert page.evaluate("document.documentElement.scrollWidth") <= width
