import json
import re
import shutil
from html.parser import HTMLParser
from types import SimpleNamespace

import pytest

from drake_safety.evaluation.report import write_report
from report_runs import write_run

pytestmark = pytest.mark.train

EMPTY_TAGS = {"meta", "img"}


class Page(HTMLParser):
    """The elements and the visible text of a page; every element must be closed in order."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.open, self.text = [], [], []
        self.feed(text)
        self.close()
        assert self.open == []
        self.words = " ".join(" ".join(self.text).split())

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag not in EMPTY_TAGS:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.text.append(data)

    def all(self, tag, name):
        return [a[name] for t, a in self.elements if t == tag and name in a]


def page_of(folder):
    file = write_report(folder, episodes=folder / "episodes", versions={"drake_safety": "test"})
    return file.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "lip"
    folder.mkdir()
    assessment = write_run(folder)
    text = page_of(folder)
    return SimpleNamespace(folder=folder, assessment=assessment, text=text, page=Page(text))


@pytest.fixture
def copy(whole, tmp_path):
    return shutil.copytree(whole.folder, tmp_path / "lip")


def test_the_page_asks_nothing_of_any_other_place(whole):
    assert all(source.startswith("data:") for source in whole.page.all("img", "src"))
    assert not {tag for tag, _ in whole.page.elements} & {"script", "link", "iframe", "object"}
    assert not re.search(r"url\(|@import|https?:", whole.text)
    assert "default-src 'none'" in "".join(whole.page.all("meta", "content"))


def test_it_says_what_was_learned_from_what_is_promised_and_where_a_baseline_is_better(whole):
    words = whole.page.words
    assert "drake-safety train lip --episodes 60" in words
    assert f"training: 60 of plant “nominal”, seed {whole.assessment.info_.seed}" in words
    for name in whole.assessment.info_.constraint_names:
        assert name.replace("_", " ") in words
    assert words.count("nothing: drake-safety calibrate chooses thresholds") == 2
    assert "drake-safety evaluate lip --assessment" in words
    assert "AUC: gradient boosting, 0.950 against 0.900 (the intervals overlap)" in words
    assert whole.page.all("td", "class").count("best") == 9


def test_names_that_look_like_html_stay_text(copy):
    info = json.loads((copy / "episodes/info.json").read_text())
    info["extra"]["command"] = "drake-safety train '<script>alert(1)</script>'"
    (copy / "episodes/info.json").write_text(json.dumps(info))
    text = page_of(copy)
    assert "<script" not in text
    assert "<script>alert(1)</script>" in Page(text).words
