"""The site: `make docs`. No page asks the network for anything; equations are MathML."""

import re
from pathlib import Path
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert

from topograph import __version__
from topograph.config import Config, explained

project, author, version, release = "topograph", "the topograph authors", __version__, __version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_click"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
html_theme = "furo"
html_title = "topograph"
html_show_copyright = False
smartquotes = False  # two hyphens of an option are no dash
exclude_patterns = ["_generated"]
autodoc_typehints = "description"
autodoc_member_order = "bysource"
napoleon_use_ivar = True
nitpicky = False
html_math_renderer = "mathml"

HERE = Path(__file__).parent
(HERE / "_generated").mkdir(exist_ok=True)
(HERE / "_generated" / "settings.yaml").write_text(explained(Config()))


def _inline(self: Any, node: nodes.math) -> None:
    self.body.append(convert(node.astext()))
    raise nodes.SkipNode


def _block(self: Any, node: nodes.math_block) -> None:
    self.body.append(f'<div style="overflow-x:auto">{convert(node.astext(), display="block")}</div>')
    raise nodes.SkipNode


def _no_rst(_app: Any, what: str, _name: str, _obj: object, _options: object, lines: list[str]) -> None:
    """Docstrings are plain text: a bar or a star in them (|x|, 4 * x) is no markup, nor is a colon in a property's a type; names that share a line
    of Attributes stay together."""
    for k, line in enumerate(lines):
        if not line.startswith((":", "..")):
            line = re.sub(r"(?<![`\\])([|*])(?!`)", r"\\\1", line)
        line = re.sub(r"^( +)((?:\w+, )+\w+):", lambda m: f"{m[1]}{m[2].replace(', ', ' / ')}:", line)
        lines[k] = line.replace(": ", " – ", 1) if what in ("property", "attribute") and k == 0 else line


def setup(app: Any) -> None:
    """Equations without a script; docstrings as they are."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    app.connect("autodoc-process-docstring", _no_rst, priority=400)
