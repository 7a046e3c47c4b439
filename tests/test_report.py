"""Pages: what became of a run stands first, nothing that a recording says is taken for markup, pictures show what they claim."""

from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from topograph.audit import Finding, Verdict
from topograph.cli.localizing import tone, verdict
from topograph.evaluate import Metric
from topograph.localize import Fix, Report
from topograph.report import Page, residual_time_figure

PNG = b"\x89PNG\r\n\x1a\n"
NASTY = "<script>alert('x')</script>"


class Tags(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.words: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def test_a_refused_map_says_so_first_with_value_and_bound(tmp_path: Path) -> None:
    verdict = Verdict(
        (Finding(name="moving", value=0.8, bound=0.5, unit="", sentence="most trunks move", refuses=True),)
    )
    page = Page(
        title=NASTY, word=verdict.word, sentence="no map was saved", findings=verdict.findings, facts={"from": NASTY},
        metrics=[Metric("path error", 0.012, "m", "lower"), Metric(NASTY, float("nan"))], figures={NASTY: PNG}, notes=[NASTY],
        skipped={NASTY: 3}, walk=("map.html", "walk"),
    )  # fmt: skip
    page.write(tmp_path / "report.html")
    seen = Tags((tmp_path / "report.html").read_text())
    assert "script" not in seen.tags
    text = "".join(seen.words)
    assert text.index("refused") < text.index("path error")
    assert "most trunks move moving 0.8, bound 0.5" in text
    assert "1.2 cm" in text
    assert text.count(NASTY) == 7  # title twice, fact, metric, caption, note, reason of what was skipped


def test_residuals_over_time_show_where_a_run_went_wrong() -> None:
    """The same residuals in another order are another picture; a factor without stamps is left out."""
    t = np.arange(2000, dtype=np.int64) * 50_000_000
    r = np.random.default_rng(1).normal(size=2000)
    bad = r.copy()
    bad[500:520] *= 20
    quiet, loud = (residual_time_figure({"fix": v}, {"fix": t}, 0) for v in (r, bad))
    assert quiet.startswith(PNG)
    assert loud.startswith(PNG)
    assert quiet != loud
    assert residual_time_figure({"fix": bad}, {"fix": t[::-1].copy()}, 0) != loud
    assert residual_time_figure({"fix": r, "turn": r * np.nan}, {"fix": t, "turn": t}, 0) == quiet
    assert residual_time_figure({}, {}, 0).startswith(PNG)


def seen(state: str, along: float = 0.02) -> Report:
    fix = None if state in ("searching", "lost") else Fix(1, np.eye(4), np.eye(6), 1e-5)
    none = np.zeros(0, np.int64)
    return Report(
        stamp_ns=1, state=state, fix=fix, hypotheses=1, risk=1e-5, places=np.zeros((0, 3)), trees=none, pairs=np.zeros((0, 2), np.int64),
        along=along if fix else np.nan, across=along if fix else np.nan,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("reports", "tone_of", "says"),
    [
        ([seen("tracking")] * 10, "good", ["found after 0.0 m", "100.0 %"]),
        ([seen("tracking")] * 6 + [seen("degraded", 5.0)] * 4, "fair", ["40 %", "degraded", "5.0 m"]),
        ([seen("tracking")] * 9 + [seen("lost")], "fair", ["lost at the end", "90.0 %"]),
        ([seen("searching")] * 10, "bad", ["unknown"]),
        (
            [replace(seen("ambiguous"), fix=None, why="so regular", hypotheses=3)] * 10,
            "bad",
            ["unknown: so regular", "3 are left"],
        ),
    ],
)
def test_a_localization_says_what_came_after_it_was_found(reports: list[Report], tone_of: str, says: list[str]) -> None:
    said = verdict(reports, [0.0] * len(reports))
    assert all(w in said for w in says)
    assert tone(reports) == tone_of
