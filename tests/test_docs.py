"""Examples in docstrings run; pages name what is there."""

import doctest
import importlib
import re
from pathlib import Path

import pytest

from topograph.exchange import WRITERS

ROOT = Path(__file__).parent.parent


@pytest.mark.parametrize("module", ["topograph.geometry", "topograph.topomap.map", "topograph.topomap.edges"])
def test_examples_in_docstrings(module: str) -> None:
    found = doctest.testmod(importlib.import_module(module))
    assert found.attempted > 0
    assert found.failed == 0


def test_files_and_modules_that_pages_name_are_there() -> None:
    missing = []
    for page in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")]:
        text = page.read_text()
        for name in re.findall(r"`((?:topograph|tools|tests|docs|configs|examples)/[\w./-]+\.\w+)`", text):
            missing += [] if (ROOT / name).exists() else [(page.name, name)]
        for name in re.findall(r"`((?:trunks|estimate|localize|trees|topomap)/[\w/]+\.(?:py|json))`", text):
            missing += [] if (ROOT / "topograph" / name).exists() else [(page.name, name)]
        for link in re.findall(r"\]\(((?!https?:|#)[^)#]+)", text):
            missing += [] if (page.parent / link).exists() else [(page.name, link)]
    assert not missing


def test_every_suffix_is_on_the_page_of_formats() -> None:
    text = (ROOT / "docs" / "formats.md").read_text()
    assert not [s for s in WRITERS if f"`{s}`" not in text]
