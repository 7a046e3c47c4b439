"""QGIS styles (QML) of a map's layers: trees by kind, those that are missing in red, edges thin, ellipses as outlines."""

from __future__ import annotations

from collections.abc import Mapping

_HEAD = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"


def _options(values: Mapping[str, str]) -> str:
    return (
        '<Option type="Map">'
        + "".join(f'<Option name="{k}" type="QString" value="{v}"/>' for k, v in values.items())
        + "</Option>"
    )


def _symbol(name: str, kind: str, layer: str, values: Mapping[str, str]) -> str:
    return f'<symbol name="{name}" type="{kind}" alpha="1" clip_to_extent="1"><layer class="{layer}" enabled="1" pass="0" locked="0">{_options(values)}</layer></symbol>'


def _marker(name: str, color: str, shape: str, size: str) -> str:
    return _symbol(
        name, "marker", "SimpleMarker",
        {"name": shape, "color": color, "outline_color": "35,35,35,255", "outline_width": "0.2", "size": size, "size_unit": "MM"},
    )  # fmt: skip


_RULES = (
    ("tree", "&quot;kind&quot; = 'tree' AND &quot;state&quot; &lt;> 'missing'", ("27,120,55,255", "circle", "2.6")),
    ("tree, missing in the last session", "&quot;kind&quot; = 'tree' AND &quot;state&quot; = 'missing'", ("178,24,43,255", "cross2", "3")),
    ("post", "&quot;kind&quot; &lt;> 'tree'", ("123,92,62,255", "square", "2")),
)  # fmt: skip

_LABELS = (
    '<labeling type="simple"><settings calloutType="simple"><text-style fieldName="place" fontSize="7" fontFamily="Sans" textColor="60,60,60,255" isExpression="0"/>'
    '<text-format/><placement placement="6" dist="1"/><rendering scaleVisibility="1" scaleMin="1500" scaleMax="1" obstacle="0"/></settings></labeling>'
)


def _trees() -> str:
    rules = "".join(
        f'<rule key="r{k}" symbol="{k}" label="{label}" filter="{where}"/>'
        for k, (label, where, _) in enumerate(_RULES)
    )
    symbols = "".join(_marker(str(k), *look) for k, (_, _, look) in enumerate(_RULES))
    return (
        f'{_HEAD}<qgis version="3.22" styleCategories="Symbology|Labeling" labelsEnabled="1"><renderer-v2 type="RuleRenderer" symbollevels="0" forceraster="0">'
        f'<rules key="root">{rules}</rules><symbols>{symbols}</symbols></renderer-v2>{_LABELS}</qgis>'
    )


def _single(symbol: str) -> str:
    return (
        f'{_HEAD}<qgis version="3.22" styleCategories="Symbology"><renderer-v2 type="singleSymbol" symbollevels="0" forceraster="0">'
        f"<symbols>{symbol}</symbols></renderer-v2></qgis>"
    )


def _line(color: str, width: str) -> str:
    return _symbol(
        "0",
        "line",
        "SimpleLine",
        {"line_color": color, "line_width": width, "line_width_unit": "MM", "line_style": "solid"},
    )


STYLES = {
    "trees": _trees(),
    "edges": _single(_line("150,165,155,255", "0.2")),
    "path": _single(_marker("0", "33,102,172,255", "circle", "0.6")),
    "path_lines": _single(_line("33,102,172,255", "0.4")),
    "ellipses": _single(
        _symbol(
            "0",
            "fill",
            "SimpleFill",
            {"style": "no", "outline_color": "27,120,55,255", "outline_width": "0.3", "outline_style": "solid"},
        )
    ),
}
"""Feature table -> QML."""
