"""Pages: what became of a run stands first, nothing that a recording says is taken for markup, pictures show what they claim."""

from html.parser import HTMLParser
from pathlib import Path

import numpy as np

from topograph.audit import Finding, Verdict
from topograph.evaluate import Metric
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
    quiet, loud = (residual_time_figure({"fix": v}, {"fix": t}) for v in (r, bad))
    assert quiet.startswith(PNG)
    assert loud.startswith(PNG)
    assert quiet != loud
    assert residual_time_figure({"fix": bad}, {"fix": t[::-1].copy()}) != loud
    assert residual_time_figure({"fix": r, "turn": r}, {"fix": t}) == quiet
    assert residual_time_figure({}, {}).startswith(PNG)
