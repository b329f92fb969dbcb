"""The report of a run: it shows what there is, names what is not, and needs nothing but itself."""

import base64
import gzip
import json
import re
import shutil
import sys
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest

from drake_safety.evaluation.report import page
from drake_safety.evaluation.report.cell_map import map_cells, map_views, most_typical
from drake_safety.evaluation.report.page import write_report
from drake_safety.evaluation.report.run_folder import read_run
from drake_safety.learning.beliefs import SAFE, UNSAFE
from report_runs import (
    MODES,
    write_evaluation,
    write_run,
)

pytestmark = pytest.mark.train

EMPTY_TAGS = {"meta", "link", "img", "br", "hr", "input", "rect", "path", "line", "col"}


class Page(HTMLParser):
    """The page as a browser would take it apart; what does not close is an error."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.text, self.open = [], [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag not in EMPTY_TAGS:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("script", "style"):
            self.text.append(data)

    @property
    def words(self):
        return " ".join(" ".join(self.text).split())

    def all(self, tag, **attributes):
        found = [a for t, a in self.elements if t == tag]
        return [a for a in found if all(a.get(k) == v for k, v in attributes.items())]


def read(folder):
    return read_run(
        folder,
        episodes=folder / "episodes",
        assessments={mode: folder / f"{mode}.safetensors" for mode in MODES},
    )


def page_of(folder):
    return write_report(read(folder), versions={"drake_safety": "test"})


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "lip"
    folder.mkdir()
    episodes, assessment = write_run(folder)
    file = page_of(folder)
    text = file.read_text(encoding="utf-8")
    return SimpleNamespace(
        folder=folder, episodes=episodes, assessment=assessment, text=text, page=Page(text)
    )


@pytest.fixture
def copy(whole, tmp_path, monkeypatch):
    """A copy of the whole run; the figures of its report are taken over, not drawn again."""
    folder = tmp_path / "lip"
    shutil.copytree(whole.folder, folder)

    def drawn_before(fig, path):
        path.parent.mkdir(parents=True, exist_ok=True)
        figures = whole.folder / "report/figures"
        names = [path.with_suffix(suffix).name for suffix in (".png", ".svg")]
        return [shutil.copy(figures / name, path.with_name(name)) for name in names]

    monkeypatch.setattr("drake_safety.evaluation.report.page.save", drawn_before)
    return folder


def test_a_whole_run_has_nothing_missing_and_every_section(whole):
    page = whole.page
    assert not page.all("section", id="missing")
    sections = {a["id"] for a in page.all("section") if "id" in a}
    assert {"trained", "motion", "map", "paper", "verdicts", "calibration", "terms"} <= sections
    linked = {a["href"].removeprefix("#") for a in page.all("a") if a["href"].startswith("#")}
    assert linked <= sections


def test_the_page_asks_nothing_of_any_other_place(whole):
    for tag, attributes in whole.page.elements:
        for name in ("src", "srcset", "poster", "data"):
            assert attributes.get(name, "data:").startswith("data:"), (tag, attributes)
        assert tag not in ("link", "base", "object", "embed")
        if tag == "a":
            assert "//" not in attributes["href"]
    assert not re.search(r"url\((?!#)|@import", whole.text)
    (policy,) = whole.page.all("meta", **{"http-equiv": "Content-Security-Policy"})
    assert "default-src 'none'" in policy["content"]
    assert "http" not in policy["content"]


def test_every_link_to_a_file_leads_to_one(whole):
    files = [a["href"] for a in whole.page.all("a") if not a["href"].startswith("#")]
    assert files
    assert [name for name in files if not (whole.folder / "report" / name).is_file()] == []


def test_every_figure_is_there_as_svg_and_png(whole):
    figures = {path.name for path in (whole.folder / "report/figures").iterdir()}
    for stem in (
        "run_timeline",
        "roc",
        "a_new_figure",
        "map_sharpened",
        "map_paper",
    ):
        assert {f"{stem}.svg", f"{stem}.png"} <= figures


def test_what_was_trained_is_told_with_its_share_of_unsafe_ones(whole):
    share = 100 * whole.episodes.num_unsafe / len(whole.episodes)
    assert f"60, {share:.1f} % unsafe" in whole.page.words
    assert "pendulum" in whole.page.words
    assert "drake-safety train lip --episodes 60" in whole.page.words


def test_where_a_baseline_is_better_is_shown(whole):
    assert "AUC: gradient boosting, 0.950 against 0.900 (the intervals overlap)" in (
        whole.page.words
    )


def test_the_recording_lies_in_the_page_as_it_was(whole):
    (packed,) = re.findall(r'id="recording-1">([^<]+)<', whole.text)
    recording = gzip.decompress(base64.b64decode(packed)).decode()
    assert recording == (whole.folder / "run/recording.html").read_text()


def test_a_cell_says_the_belief_and_the_count_that_the_assessment_has(whole):
    cells = map_cells(whole.assessment, whole.episodes)
    beliefs = whole.assessment.beliefs_[0]
    np.testing.assert_allclose([c["belief"] for c in cells], beliefs[:, :3], atol=1e-4)
    np.testing.assert_allclose([c["causes"] for c in cells], beliefs[:, 3:], atol=1e-4)
    grid = whole.assessment.grid_
    assert sum(c["count"] for c in cells) == np.sum(
        grid.locate(whole.assessment.training_.points[0]) >= 0
    )
    assert len(whole.page.all("rect", **{"class": "cell"})) == 2 * grid.num_cells
    labels = [a["aria-label"] for a in whole.page.all("rect", **{"class": "cell"})]
    assert all("segments" in label for label in labels)


def test_a_typical_episode_is_one_of_the_cell_with_its_margins_and_its_end(whole):
    cells = map_cells(whole.assessment, whole.episodes, angular_constraints=["height"])
    typical = [c for c in cells if c["typical"]]
    assert [c["count"] > 0 for c in cells] == [c["typical"] is not None for c in cells]
    by_index = {episode.index: episode for episode in whole.episodes}
    for cell in typical:
        episode = by_index[cell["typical"]["episode"]]
        assert cell["typical"]["cause"] == episode.cause
        expected = episode.margins * [100.0, np.degrees(1.0)]
        np.testing.assert_allclose(cell["typical"]["margins"], expected.T, atol=0.006)
    # Where all that is known is safe or unsafe, so is the episode.
    for cell in typical:
        if cell["count"] >= 3 and cell["belief"][UNSAFE] == 0.0:
            assert cell["typical"]["cause"] == ""
        if cell["count"] >= 3 and cell["belief"][SAFE] < 0.05:
            assert cell["typical"]["cause"] != ""


def test_the_typical_segment_ends_as_most_do_and_lies_in_their_middle():
    segments = SimpleNamespace(
        is_unsafe=np.array([True, True, True, False, True]), cause=np.array([1, 1, 1, -1, 0])
    )
    points = np.array([[0.0, 0.0], [1.0, 0.0], [2.2, 0.0], [1.0, 0.1], [1.1, 0.0]])
    assert most_typical(segments, points, np.arange(5)) == 1
    assert most_typical(segments, points, np.array([3])) == 3


def test_empty_cells_have_no_colour_and_safer_ones_are_bluer(whole):
    cells = map_cells(whole.assessment)
    fills = map_views(whole.assessment, cells)["safe"]["fills"]
    is_empty = [cell["belief"][2] == 1.0 for cell in cells]
    assert [fill is None for fill in fills] == is_empty
    assert any(is_empty)
    known = [i for i, empty in enumerate(is_empty) if not empty]
    by_safety = sorted(known, key=lambda i: cells[i]["belief"][SAFE])
    blue = [int(fills[i][5:7], 16) - int(fills[i][1:3], 16) for i in by_safety]
    assert blue[0] < 0 < blue[-1]


@pytest.mark.parametrize(
    ("gone", "named"),
    [
        (["episodes"], "Training episodes"),
        (["evaluation.json"], "The run was not evaluated"),
        (["paper.safetensors"], "The learned assessment, mode “paper”"),
        (["run/recording.html"], "A recorded motion"),
        (["episodes", "sharpened.safetensors", "paper.safetensors"], "Training episodes"),
        (["sharpened.safetensors", "paper.safetensors", "evaluation.json", "run"], "evaluation"),
    ],
)
def test_what_a_half_finished_run_lacks_is_named_and_the_rest_shown(copy, gone, named):
    for name in gone:
        path = copy / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    page = Page(page_of(copy).read_text(encoding="utf-8"))
    # At the end, folded.
    assert page.all("section")[-1] == {"id": "missing"}
    assert page.words.index("Not in this run:") > page.words.index("Provenance")
    start = page.elements.index(("section", {"id": "missing"}))
    assert page.elements[start + 1] == ("details", {})
    assert named.lower() in page.words.lower()
    if "evaluation.json" not in gone:
        assert "0.900 (0.795–0.962)" in page.words
    if "episodes" not in gone:
        assert "60 simulated motions" in page.words


def test_damaged_files_and_a_stopped_training_are_named_and_the_rest_shown(copy):
    (copy / "evaluation.json").write_text('{"segments.')
    (copy / "sharpened.safetensors").write_bytes(b"half of it")
    info = json.loads((copy / "episodes/info.json").read_text())
    info["extra"]["command"] = "drake-safety train lip --episodes 2048"
    (copy / "episodes/info.json").write_text(json.dumps(info))
    page = Page(page_of(copy).read_text(encoding="utf-8"))
    assert "evaluation.json holds no results" in page.words
    assert "is not a safety assessment or truncated" in page.words
    assert "60 of 2048 are here" in page.words
    assert len(page.all("article", **{"data-mode": "paper"})) == 1
    assert not page.all("article", **{"data-mode": "sharpened"})


def test_an_evaluation_of_another_simulation_is_shown_and_said_to_be_foreign(copy):
    write_evaluation(copy, scenario_hash="f" * 64)
    page = Page(page_of(copy).read_text(encoding="utf-8"))
    assert "its results below are of another scenario" in page.words
    assert "0.900 (0.795–0.962)" in page.words


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    (tmp_path / "holiday.jpg").write_bytes(b"")
    with pytest.raises(ValueError, match=r"is no run: it holds none of .*holiday\.jpg"):
        read(tmp_path)
    with pytest.raises(ValueError, match="there is no folder"):
        read(tmp_path / "nowhere")


def test_names_that_look_like_html_stay_text(copy):
    info = json.loads((copy / "episodes/info.json").read_text())
    info["extra"]["command"] = "drake-safety train '<script>alert(1)</script>'"
    (copy / "episodes/info.json").write_text(json.dumps(info))
    text = page_of(copy).read_text(encoding="utf-8")
    assert "<script>alert" not in text
    assert "<script>alert(1)</script>" in Page(text).words


def test_a_page_without_what_writes_it_names_the_extra(copy, monkeypatch):
    page._environment.cache_clear()
    monkeypatch.setitem(sys.modules, "jinja2", None)
    with pytest.raises(ValueError, match=r"pip install 'drake_safety\[report\]'"):
        page_of(copy)
