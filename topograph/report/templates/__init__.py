"""Pages as Jinja templates: whatever is put in is escaped."""

from __future__ import annotations

from typing import Any


def render(name: str, **values: Any) -> str:
    """A page of a template in this folder."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    env = Environment(
        loader=PackageLoader("topograph.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    return str(env.get_template(name).render(**values))
