"""`report.html`: one file, no network, opens anywhere."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from topograph.evaluate import Metric
from topograph.geometry import Array
from topograph.report.record import write_text
from topograph.topomap import CHI2_95, KINDS, TopoMap

_STYLE = """
:root{color-scheme:light dark;--ink:#1d2420;--soft:#5c6a61;--line:#d8dfda;--card:#fff;--page:#f5f7f5;--tree:#1b7837}
@media(prefers-color-scheme:dark){:root{--ink:#e6ece8;--soft:#9aa8a0;--line:#37413b;--card:#1d2420;--page:#141a17;--tree:#5aae61}}
*{box-sizing:border-box}body{font:15px/1.5 system-ui,sans-serif;margin:0;background:var(--page);color:var(--ink)}
main{max-width:1100px;margin:0 auto;padding:24px 16px}h1{font-size:24px;margin:0 0 4px}h2{font-size:17px;margin:28px 0 8px}
.sub{color:var(--soft);margin:0 0 16px}.cards{display:grid;grid-template-columns:repeat(auto-fill,minmax(170px,1fr));gap:10px}
.card{background:var(--card);border:1px solid var(--line);border-radius:8px;padding:10px 12px}
.card b{display:block;font-size:20px}.card span{color:var(--soft);font-size:13px}
#map{width:100%;height:560px;background:var(--card);border:1px solid var(--line);border-radius:8px;touch-action:none;cursor:grab}
img{max-width:100%;background:#fff;border-radius:8px;border:1px solid var(--line)}
table{border-collapse:collapse;background:var(--card);width:100%}td,th{border:1px solid var(--line);padding:4px 8px;text-align:left;
font-variant-numeric:tabular-nums}td.n{text-align:right}.note{border-left:4px solid #d9a441;background:var(--card);padding:8px 12px;margin:8px 0}
#tip{position:fixed;pointer-events:none;background:var(--ink);color:var(--page);padding:4px 8px;border-radius:6px;font-size:13px;display:none}
.scroll{overflow-x:auto}
"""

_SCRIPT = """
const D=JSON.parse(document.getElementById('data').textContent),s=document.getElementById('map'),tip=document.getElementById('tip');
const N='http://www.w3.org/2000/svg';function el(n,a,p){const e=document.createElementNS(N,n);for(const k in a)e.setAttribute(k,a[k]);p.appendChild(e);return e}
const xs=D.trees.map(t=>t.x).concat(D.path.map(p=>p[0])),ys=D.trees.map(t=>t.y).concat(D.path.map(p=>p[1]));
let lo=[Math.min(...xs)-4,Math.min(...ys)-4],hi=[Math.max(...xs)+4,Math.max(...ys)+4];
let box={x:lo[0],y:-hi[1],w:hi[0]-lo[0],h:hi[1]-lo[1]};
function view(){s.setAttribute('viewBox',`${box.x} ${box.y} ${box.w} ${box.h}`)}view();
const g=el('g',{},s),u=Math.max(box.w,box.h)/600;
D.edges.forEach(e=>{const a=D.trees[e[0]],b=D.trees[e[1]];el('line',{x1:a.x,y1:-a.y,x2:b.x,y2:-b.y,stroke:'#9fb0a5','stroke-width':u},g)});
el('polyline',{points:D.path.map(p=>p[0]+','+(-p[1])).join(' '),fill:'none',stroke:'#2166ac','stroke-width':1.4*u},g);
D.truth.forEach(p=>{el('path',{d:`M${p[0]-6*u} ${-p[1]}h${12*u}M${p[0]} ${-p[1]-6*u}v${12*u}`,stroke:'#d6604d','stroke-width':1.2*u},g)});
D.trees.forEach(t=>{
 if(t.e)el('ellipse',{rx:t.e[0]*10,ry:t.e[1]*10,transform:`translate(${t.x} ${-t.y}) rotate(${-t.e[2]})`,fill:'none',stroke:'#1b7837','stroke-width':.7*u},g);
 const c=el('circle',{cx:t.x,cy:-t.y,r:Math.max(t.d/2,2.5*u),fill:t.k?'#7b5c3e':'#1b7837'},g);
 c.addEventListener('pointermove',v=>{tip.style.display='block';tip.style.left=v.clientX+12+'px';tip.style.top=v.clientY+12+'px';tip.textContent=t.t});
 c.addEventListener('pointerleave',()=>tip.style.display='none')});
s.addEventListener('wheel',e=>{e.preventDefault();const r=s.getBoundingClientRect(),f=e.deltaY>0?1.15:1/1.15;
 const px=box.x+(e.clientX-r.left)/r.width*box.w,py=box.y+(e.clientY-r.top)/r.height*box.h;
 box={x:px-(px-box.x)*f,y:py-(py-box.y)*f,w:box.w*f,h:box.h*f};view()},{passive:false});
let from=null;s.addEventListener('pointerdown',e=>{from=[e.clientX,e.clientY];s.setPointerCapture(e.pointerId)});
s.addEventListener('pointermove',e=>{if(!from)return;const r=s.getBoundingClientRect(),k=Math.max(box.w/r.width,box.h/r.height);
 box.x-=(e.clientX-from[0])*k;box.y-=(e.clientY-from[1])*k;from=[e.clientX,e.clientY];view()});
s.addEventListener('pointerup',()=>from=null);
"""


def write_page(
    path: Path,
    title: str,
    topo: TopoMap | None,
    metrics: Sequence[Metric],
    figures: Mapping[str, bytes],
    skipped: Mapping[str, int],
    notes: Sequence[str],
    facts: Mapping[str, str],
    true_trees: Array | None = None,
) -> None:
    """Write the page: key figures, a map to zoom and hover, pictures (PNG by caption), what was skipped and assumed."""
    cards = "".join(
        f'<div class="card"><b>{html.escape(show(m))}</b><span>{html.escape(m.name)}</span></div>' for m in metrics
    )
    parts = [
        f"<h1>{html.escape(title)}</h1>",
        f'<p class="sub">{html.escape(" · ".join(f"{k} {v}" for k, v in facts.items()))}</p>',
    ]
    parts += [f'<p class="note">{html.escape(n)}</p>' for n in notes]
    parts.append(f'<div class="cards">{cards}</div>')
    script = ""
    if topo is not None and len(topo):
        data = json.dumps(_map_data(topo, true_trees), separators=(",", ":")).replace("<", "\\u003c")
        parts.append('<h2>Map</h2><svg id="map" role="img" aria-label="map of the trees"></svg><div id="tip"></div>')
        parts.append(
            '<p class="sub">Drag to move, wheel to zoom, point at a tree for its facts. Ellipses: 95 %, ten times enlarged.'
            + (" Crosses: truth." if true_trees is not None else "")
            + "</p>"
        )
        script = f'<script type="application/json" id="data">{data}</script><script>{_SCRIPT}</script>'
    for caption, png in figures.items():
        code = base64.b64encode(png).decode()
        parts.append(
            f'<h2>{html.escape(caption)}</h2><img alt="{html.escape(caption)}" src="data:image/png;base64,{code}">'
        )
    rows = "".join(f'<tr><td>{html.escape(k)}</td><td class="n">{v}</td></tr>' for k, v in sorted(skipped.items()))
    parts.append(
        f'<h2>Skipped</h2><div class="scroll"><table><tr><th>reason</th><th>count</th></tr>{rows}</table></div>'
        if rows
        else "<h2>Skipped</h2><p>Nothing.</p>"
    )
    write_text(
        path,
        "<!doctype html><html lang=en><head><meta charset=utf-8><meta name=viewport content='width=device-width,initial-scale=1'>"
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head><body><main>{''.join(parts)}</main>{script}</body></html>\n",
    )


def show(m: Metric) -> str:
    """A metric's value for people: centimetres where metres would be all zeros."""
    v = m.value
    if not np.isfinite(v):
        return "–"
    if m.unit == "m":
        return f"{100 * v:.1f} cm" if abs(v) < 1 else f"{v:.2f} m"
    if m.unit == "rad":
        return f"{np.degrees(v):.2f}°"
    if isinstance(v, int) or (float(v).is_integer() and abs(v) >= 2):
        return f"{int(v)} {m.unit}".strip()
    return f"{v:.3f} {m.unit}".strip()


def _map_data(topo: TopoMap, true_trees: Array | None) -> dict[str, object]:
    trees = []
    geodetic = topo.geodetic()
    radii, angle = topo.ellipses()
    for i in range(len(topo)):
        d = float(topo.diameter[i]) if np.isfinite(topo.diameter[i]) else 0.2
        ellipse = None
        sigma = ""
        if np.isfinite(topo.cov[i]).all():
            ellipse = [*np.round(radii[i], 5).tolist(), round(float(np.degrees(angle[i])), 1)]
            sigma = f", σ {100 * radii[i, 0] / np.sqrt(CHI2_95):.1f} cm"
        place = "" if topo.datum is None else f", {geodetic[i, 0]:.7f}°, {geodetic[i, 1]:.7f}°"
        row = "" if topo.row[i] < 0 else f", row {topo.row[i]}"
        text = f"{KINDS[int(topo.kind[i])]} {topo.ids[i]}: Ø {100 * d:.0f} cm, {topo.sightings[i]} sightings{sigma}{row}{place}"
        trees.append(
            {
                "x": round(float(topo.p[i, 0]), 3),
                "y": round(float(topo.p[i, 1]), 3),
                "d": round(d, 3),
                "e": ellipse,
                "t": text,
                "k": int(topo.kind[i]),
            }
        )
    every = max(1, len(topo.stamps_ns) // 3000)
    track = topo.map_T_robot[::every, :2, 3]
    return {
        "trees": trees,
        "edges": topo.edges.tolist(),
        "path": [[round(float(x), 2), round(float(y), 2)] for x, y in track],
        "truth": [] if true_trees is None else [[round(float(x), 3), round(float(y), 3)] for x, y in true_trees[:, :2]],
    }
