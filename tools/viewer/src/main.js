import { Deck, OrthographicView } from '@deck.gl/core';
import { read, bounds } from './data.js';
import { mapLayers, localizationLayers, inside, look, COLORS, ELLIPSE_ZOOM, LABEL_ZOOM } from './layers.js';
import { showCloud, sideColor } from './cloud.js';

const began = performance.now();
const $ = (id) => document.getElementById(id);
const D = read($('data'));
const t = D.trees, L = D.localization;
const dark = matchMedia('(prefers-color-scheme: dark)');
const ui = { show: { edges: true, path: true, ellipses: true, labels: true }, times: 1, session: 0, selected: -1, side: -1, zoom: 0, visible: [], step: L ? L.time.length - 1 : 0, dark: dark.matches, playing: false };

const box = bounds([[t.x, t.y], ...D.paths.map((p) => [p.points.filter((_, i) => i % 2 === 0), p.points.filter((_, i) => i % 2 === 1)])]);
const stage = $('map');
const fit = () => {
  const w = stage.clientWidth || 800, h = stage.clientHeight || 600;
  const zoom = Math.log2(Math.min(w / (box[2] - box[0] + 6), h / (box[3] - box[1] + 6)));
  return { target: [(box[0] + box[2]) / 2, (box[1] + box[3]) / 2, 0], zoom: Number.isFinite(zoom) ? zoom : 3, minZoom: -8, maxZoom: 10 };
};
let viewState = fit();

const deck = new Deck({
  parent: stage, width: '100%', height: '100%', views: new OrthographicView({ flipY: false }), viewState, controller: { keyboard: true, dragRotate: false, doubleClickZoom: false },
  getCursor: ({ isHovering, isDragging }) => (isDragging ? 'grabbing' : isHovering ? 'pointer' : 'grab'), pickingRadius: 12,
  onViewStateChange: (e) => { viewState = e.viewState; deck.setProps({ viewState }); later(); },
  getTooltip: ({ layer, index }) => (layer && layer.id === 'trees' && index >= 0 ? { text: title(index), className: 'tip' } : null),
  onLoad: () => { ui.ready = true; },
  onAfterRender: () => {
    if (document.body.dataset.drawn || !ui.ready || !deck.props.layers.length || !deck.layerManager.getLayers().every((l) => l.isLoaded)) return;
    document.body.dataset.drawn = (performance.now() - began).toFixed(0);
  },
  onError: (e) => { document.body.dataset.error = String(e && e.message); },
});
stage.querySelector('canvas')?.setAttribute('tabindex', '0');
stage.querySelector('canvas')?.setAttribute('aria-label', 'Map of the trees; arrow keys move, plus and minus zoom, click a tree for its facts');

// A click is a press that did not move, however long a slow machine took over it.
let pressed = null;
stage.addEventListener('pointerdown', (e) => { pressed = { x: e.clientX, y: e.clientY, id: e.pointerId }; }, true);
stage.addEventListener('pointerup', (e) => {
  const p = pressed;
  pressed = null;
  if (!p || p.id !== e.pointerId || Math.hypot(e.clientX - p.x, e.clientY - p.y) > 6) return;
  const r = stage.getBoundingClientRect();
  const hit = deck.pickObject({ x: e.clientX - r.left, y: e.clientY - r.top, radius: 12, layerIds: ['trees'] });
  select(hit ? hit.index : -1);
}, true);

let timer = 0;
const later = () => { scale(); clearTimeout(timer); timer = setTimeout(draw, 60); };

function draw() {
  ui.zoom = viewState.zoom;
  if (ui.zoom > Math.min(ELLIPSE_ZOOM, LABEL_ZOOM)) {
    const w = stage.clientWidth / 2 ** ui.zoom / 2 + 2, h = stage.clientHeight / 2 ** ui.zoom / 2 + 2, [x, y] = viewState.target;
    ui.visible = inside(t, [x - w, y - h, x + w, y + h]);
  } else ui.visible = [];
  deck.setProps({ layers: [...mapLayers(D, ui), ...localizationLayers(D, ui)] });
}

function scale() {
  const perMetre = 2 ** viewState.zoom, want = 120 / perMetre;
  const step = 10 ** Math.floor(Math.log10(want)), length = [5, 2, 1].map((k) => k * step).find((v) => v <= want) || step;
  $('bar').style.width = `${length * perMetre}px`;
  $('bartext').textContent = length >= 1000 ? `${length / 1000} km` : length >= 1 ? `${length} m` : `${Math.round(length * 100)} cm`;
}

const title = (i) => `${look(t, i)} ${t.place[i] || t.id[i]}`;
const row = (k, v) => { const tr = document.createElement('tr'); for (const x of [k, v]) { const td = document.createElement('td'); td.textContent = x; tr.append(td); } return tr; };

function select(i) {
  ui.selected = i;
  ui.side = -1;
  const panel = $('facts');
  panel.hidden = i < 0;
  document.body.classList.toggle('open', i >= 0);
  if (i >= 0) {
    $('name').textContent = title(i);
    const cm = (v) => (v > 0 ? `${(100 * v).toFixed(1)} cm` : 'not known');
    const rows = [['number', t.id[i]], ['x, y, z', `${t.x[i].toFixed(2)}, ${t.y[i].toFixed(2)}, ${t.z[i].toFixed(2)} m`]];
    if (D.lat) rows.push(['latitude, longitude', `${D.lat[i]}, ${D.lon[i]}`]);
    rows.push(['position, 95 %', t.a[i] > 0 ? `± ${(100 * t.a[i]).toFixed(1)} × ${(100 * t.b[i]).toFixed(1)} cm` : 'not stated'], ['diameter', cm(t.d[i])], ['stems', t.stems[i]],
      ['lean', `${((Math.acos(Math.min(1, t.az[i])) * 180) / Math.PI).toFixed(1)}°`], ['kind', `${look(t, i) === 'missing' ? 'tree' : look(t, i)}${t.chance[i] >= 0 ? ` (${(100 * t.chance[i]).toFixed(0)} %)` : ''}`],
      ['state', t.missing[i] ? 'missing: the last session saw through its place' : 'standing'], ['seen', `${t.sightings[i]} times`]);
    $('rows').replaceChildren(...rows.map(([k, v]) => row(k, String(v))));
    $('sessions').replaceChildren(...D.sessions.map((s, k) => { const n = D.seen[k][i]; return row(s.name, n > 0 ? `${n} sightings` : 'not seen'); }));
    clouds(i);
  }
  draw();
}

async function clouds(i) {
  let views = D.views[i] || [];
  if (D.served && views.length && !views[0].cloud) {
    const got = await (await fetch(`clouds/${t.id[i]}`)).json();
    views = D.views[i] = got.map((v) => ({ dx: v.dx, dy: v.dy, cloud: Int16Array.from(v.cloud) }));
  }
  const with3d = views.some((v) => v.cloud && v.cloud.length);
  $('cloud').hidden = !with3d;
  $('sides').replaceChildren();
  if (!with3d) return;
  const button = (label, k, color) => { const b = document.createElement('button'); b.textContent = label; b.style.borderColor = color; b.setAttribute('aria-pressed', String(ui.side === k)); b.onclick = () => { ui.side = k; clouds(i); }; return b; };
  // A local frame has no north: sides are angles from its x axis.
  const angle = (v) => (Math.atan2(v.dy, v.dx) + 2 * Math.PI) % (2 * Math.PI);
  const compass = (v) => (D.lat ? ['E', 'NE', 'N', 'NW', 'W', 'SW', 'S', 'SE'][Math.round(angle(v) / (Math.PI / 4)) % 8] : `${Math.round(angle(v) * 180 / Math.PI)}°`);
  const names = views.map(compass);
  const named = names.map((n, k) => (names.filter((m) => m === n).length > 1 ? `${n} (${names.slice(0, k + 1).filter((m) => m === n).length})` : n));
  $('sides').append(button('all sides', -1, 'currentColor'), ...views.map((_, k) => button(`from ${named[k]}`, k, sideColor(k))));
  showCloud($('cloud'), views, [t.ax[i], t.ay[i], t.az[i]], ui.side);
}

function goTo(i, zoom = 5) {
  viewState = { ...viewState, target: [t.x[i], t.y[i], 0], zoom: Math.max(viewState.zoom, zoom) };
  deck.setProps({ viewState });
  select(i);
  scale();
}

$('search').addEventListener('change', (e) => {
  const word = e.target.value.trim().toLowerCase();
  if (!word) return;
  let i = t.place.findIndex((p) => p.toLowerCase() === word);
  if (i < 0) i = t.id.indexOf(Number(word.replace(/^\D+/, '')));
  $('found').textContent = i < 0 ? `no tree is called ${e.target.value}` : '';
  if (i >= 0) goTo(i);
});
for (const k of Object.keys(ui.show)) $(`show-${k}`).addEventListener('change', (e) => { ui.show[k] = e.target.checked; draw(); });
$('times').addEventListener('change', (e) => { ui.times = e.target.checked ? 10 : 1; draw(); });
$('home').addEventListener('click', () => { viewState = fit(); deck.setProps({ viewState }); later(); });
$('close').addEventListener('click', () => select(-1));
if (D.sessions.length > 1) {
  $('session').hidden = false;
  D.sessions.slice(0, 30).forEach((s, k) => $('session').append(new Option(s.name, String(k + 1))));
  $('session').addEventListener('change', (e) => { ui.session = Number(e.target.value); draw(); });
}
dark.addEventListener('change', () => { ui.dark = dark.matches; draw(); });

if (L) {
  $('replay').hidden = false;
  $('legend').append(document.createElement('br'), ...L.states.filter((_, k) => L.state.includes(k)).map((s) => { const e = document.createElement('span'), dot = document.createElement('i'); dot.style.background = dot.style.borderColor = `rgb(${COLORS[s].join(',')})`; e.append(dot, `${s} `); return e; }));
  const slider = $('time');
  slider.max = String(L.time.length - 1);
  slider.value = String(ui.step);
  const tell = () => {
    const k = ui.step, state = L.states[L.state[k]];
    const places = L.count[k] > 1 ? `, ${L.count[k]} places left` : '';
    const sigma = Number.isFinite(L.x[k]) ? `, ± ${(100 * Math.max(L.sigmaA[k], L.sigmaB[k])).toFixed(1)} cm` : ', no pose';
    const error = L.error && Number.isFinite(L.error[k]) ? `, off by ${(100 * L.error[k]).toFixed(1)} cm` : '';
    $('now').textContent = `${L.time[k].toFixed(1)} s: ${state}${places}${sigma}${error}, sees ${L.seenStart[k + 1] - L.seenStart[k]} known trees`;
    $('now').style.borderColor = `rgb(${COLORS[state].join(',')})`;
  };
  const go = (k) => { ui.step = Math.max(0, Math.min(L.time.length - 1, k)); slider.value = String(ui.step); tell(); draw(); };
  slider.addEventListener('input', () => go(Number(slider.value)));
  let last = 0, clock = 0;
  const frame = (now) => {
    if (!ui.playing) return;
    clock += ((now - last) / 1000) * Number($('speed').value);
    last = now;
    let k = ui.step;
    while (k < L.time.length - 1 && L.time[k + 1] <= clock) k++;
    if (k !== ui.step) go(k);
    if (k >= L.time.length - 1) return play(false);
    requestAnimationFrame(frame);
  };
  const play = (on) => {
    ui.playing = on;
    $('play').textContent = on ? 'Pause' : 'Play';
    if (!on) return;
    if (ui.step >= L.time.length - 1) go(0);
    clock = L.time[ui.step];
    last = performance.now();
    requestAnimationFrame(frame);
  };
  $('play').addEventListener('click', () => play(!ui.playing));
  addEventListener('keydown', (e) => {
    if (e.target.tagName === 'INPUT' && e.target.type !== 'range') return;
    if (e.key === ' ' && e.target.tagName !== 'BUTTON') { e.preventDefault(); play(!ui.playing); }
  });
  tell();
}
addEventListener('keydown', (e) => {
  if (e.key === 'Escape') select(-1);
  if (e.key === '/' && e.target.type !== 'search') { e.preventDefault(); $('search').focus(); }
});
addEventListener('resize', later);
window.topograph = { D, ui, select, goTo, state: () => viewState, project: (i) => deck.getViewports()[0].project([t.x[i], t.y[i]]) };
scale();
draw();
