"""Figures and pictures of README and Results are those that `benchmarks/figures.py` has written."""

import hashlib
import json
import re

import pytest

from benchmarks import figures

RESULTS = json.loads(figures.FIGURES.read_text(encoding="utf-8"))
NUMBER = re.compile(r"\d\d\.\d+ / \d\d\.\d+")


@pytest.mark.parametrize("page", figures.PAGES)
def test_blocks_of_a_page_are_those_of_the_file(page):
    text = (figures.ROOT / page).read_text(encoding="utf-8")
    assert "<!-- figures: " in text
    assert figures.fill(text, RESULTS) == text


def test_every_block_is_on_a_page():
    text = "".join((figures.ROOT / page).read_text(encoding="utf-8") for page in figures.PAGES)
    assert sorted(re.findall(r"<!-- figures: (\w+) -->", text)) == sorted(figures.BLOCKS)


def test_a_figure_that_was_changed_by_hand_is_found():
    text = (figures.ROOT / "README.md").read_text(encoding="utf-8")
    block = re.search(r"<!-- figures: summary -->.*?<!-- end -->", text, re.DOTALL)[0]
    changed = NUMBER.sub("99.9 / 99.9", block, count=1)
    assert changed != block
    assert figures.fill(changed, RESULTS) == block


def test_pictures_are_those_that_were_drawn_from_the_same_figures():
    for name, digest in RESULTS["pictures"].items():
        assert hashlib.sha256((figures.IMAGES / name).read_bytes()).hexdigest() == digest, name


def test_figures_are_of_this_version():
    assert RESULTS["about"].keys() == figures.PARTS.keys()
    assert {about["version"] for about in RESULTS["about"].values()} == {figures.version("ravg")}
