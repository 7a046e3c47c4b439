"""The topological graph: GraphML."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as ET

from topograph.exchange.attributes import columns
from topograph.topomap import TopoMap
from topograph.whole import whole

GRAPHML = "http://graphml.graphdrawing.org/xmlns"
TYPES = {int: "long", float: "double", str: "string"}


def write_graphml(topo: TopoMap, path: Path) -> None:
    """Nodes with all that is known of a tree, undirected edges with their length, m."""
    c = columns(topo)
    ET.register_namespace("", GRAPHML)
    root = ET.Element(f"{{{GRAPHML}}}graphml")
    kinds = {k: TYPES[next((type(x) for x in v if x is not None), float)] for k, v in c.items() if k != "id"}
    for k, kind in kinds.items():
        ET.SubElement(root, f"{{{GRAPHML}}}key", {"id": k, "for": "node", "attr.name": k, "attr.type": kind})
    ET.SubElement(
        root, f"{{{GRAPHML}}}key", {"id": "length", "for": "edge", "attr.name": "length", "attr.type": "double"}
    )
    graph = ET.SubElement(root, f"{{{GRAPHML}}}graph", id="orchard", edgedefault="undirected")
    for i in range(len(topo)):
        node = ET.SubElement(graph, f"{{{GRAPHML}}}node", id=str(c["id"][i]))
        for k in kinds:
            if c[k][i] is not None:
                ET.SubElement(node, f"{{{GRAPHML}}}data", key=k).text = str(c[k][i])
    for (a, b), length in zip(topo.edges.tolist(), topo.lengths.tolist(), strict=True):
        edge = ET.SubElement(graph, f"{{{GRAPHML}}}edge", source=str(c["id"][a]), target=str(c["id"][b]))
        ET.SubElement(edge, f"{{{GRAPHML}}}data", key="length").text = repr(length)
    with whole(path) as part:
        ET.ElementTree(root).write(part, encoding="utf-8", xml_declaration=True)
