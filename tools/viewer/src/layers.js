// deck.gl layers of a map and of a localization. Widths are pixels: they do not grow with the zoom.
import { ScatterplotLayer, LineLayer, PathLayer, SolidPolygonLayer, TextLayer } from '@deck.gl/layers';

export const COLORS = {
  tree: [27, 120, 55], missing: [213, 94, 0], post: [123, 92, 62], other: [120, 120, 120], edge: [150, 165, 155], path: [33, 102, 172],
  searching: [140, 140, 140], ambiguous: [230, 159, 0], tracking: [0, 114, 178], degraded: [204, 121, 167], lost: [213, 94, 0], truth: [0, 0, 0],
};
const KINDS = ['tree', 'post', 'other'];
const SESSIONS = [[33, 102, 172], [230, 159, 0], [0, 158, 115], [204, 121, 167], [86, 180, 233], [213, 94, 0]];
export const ELLIPSE_ZOOM = 3.5, LABEL_ZOOM = 3.6, MOST_SHOWN = 3000;

export const look = (t, i) => (t.kind[i] === 0 && t.missing[i] ? 'missing' : KINDS[t.kind[i]]);

export function inside(t, box) {
  const out = [];
  for (let i = 0; i < t.x.length && out.length <= MOST_SHOWN; i++)
    if (t.x[i] >= box[0] && t.x[i] <= box[2] && t.y[i] >= box[1] && t.y[i] <= box[3]) out.push(i);
  return out.length > MOST_SHOWN ? [] : out;
}

function ring(x, y, a, b, angle) {
  const c = Math.cos(angle), s = Math.sin(angle), out = [];
  for (let k = 0; k < 32; k++) {
    const u = a * Math.cos((k * Math.PI) / 16), v = b * Math.sin((k * Math.PI) / 16);
    out.push([x + c * u - s * v, y + s * u + c * v]);
  }
  return out;
}

export function mapLayers(D, ui) {
  const t = D.trees, n = t.x.length, seen = (i) => !ui.session || t.sessions[i] & (1 << (ui.session - 1));
  const layers = [];
  if (ui.show.edges)
    layers.push(new LineLayer({
      id: 'edges', data: { length: D.edges.length / 2 }, getSourcePosition: (_, { index }) => [t.x[D.edges[2 * index]], t.y[D.edges[2 * index]]],
      getTargetPosition: (_, { index }) => [t.x[D.edges[2 * index + 1]], t.y[D.edges[2 * index + 1]]], getColor: [...COLORS.edge, 160], getWidth: 1, widthUnits: 'pixels',
    }));
  if (ui.show.path)
    layers.push(new PathLayer({
      id: 'path', data: D.paths.filter((p) => !ui.session || p.session === ui.session), getPath: (p) => p.points,
      getColor: (p) => SESSIONS[(p.session - 1) % SESSIONS.length], getWidth: 2, widthUnits: 'pixels', opacity: 0.7, positionFormat: 'XY', updateTriggers: { data: ui.session },
    }));
  layers.push(new ScatterplotLayer({
    id: 'trees', data: { length: n }, pickable: true, getPosition: (_, { index }) => [t.x[index], t.y[index]], getRadius: (_, { index }) => 0.5 * (t.d[index] || 0.2),
    radiusUnits: 'common', radiusMinPixels: n > 20000 ? 1.5 : 4, radiusMaxPixels: 60, stroked: n < 20000, lineWidthUnits: 'pixels', getLineWidth: 1.5,
    getFillColor: (_, { index }) => (seen(index) ? [...COLORS[look(t, index)], t.kind[index] === 0 && t.missing[index] ? 60 : 235] : [0, 0, 0, 0]),
    getLineColor: (_, { index }) => (seen(index) ? COLORS[look(t, index)] : [0, 0, 0, 0]), autoHighlight: true, highlightColor: [255, 200, 0, 160],
    updateTriggers: { getFillColor: ui.session, getLineColor: ui.session },
  }));
  if (ui.show.ellipses && ui.zoom > ELLIPSE_ZOOM)
    layers.push(new PathLayer({
      id: 'ellipses', data: ui.visible.filter((i) => t.a[i] > 0), getPath: (i) => ring(t.x[i], t.y[i], t.a[i] * ui.times, t.b[i] * ui.times, t.turn[i]),
      _pathType: 'loop', getColor: [...COLORS.tree, 220], getWidth: 1.5, widthUnits: 'pixels', updateTriggers: { getPath: ui.times },
    }));
  if (ui.selected >= 0) layers.push(...selectedLayers(D, ui.selected));
  if (ui.show.labels && ui.zoom > LABEL_ZOOM)
    layers.push(new TextLayer({
      id: 'labels', data: ui.visible.filter((i) => t.place[i] || i < 500), getPosition: (i) => [t.x[i], t.y[i]], getText: (i) => t.place[i] || String(t.id[i]), getSize: 12,
      getColor: ui.dark ? [210, 220, 214] : [60, 70, 64], getPixelOffset: [0, -14], fontFamily: 'system-ui, sans-serif', background: false, updateTriggers: { getColor: ui.dark },
    }));
  return layers;
}

function selectedLayers(D, i) {
  const t = D.trees, views = D.views[i] || [];
  return [
    new ScatterplotLayer({ id: 'selected', data: [i], getPosition: () => [t.x[i], t.y[i]], getRadius: 11, radiusUnits: 'pixels', filled: false, stroked: true, getLineColor: [255, 170, 0], getLineWidth: 3, lineWidthUnits: 'pixels' }),
    new LineLayer({ id: 'rose', data: views, getSourcePosition: () => [t.x[i], t.y[i]], getTargetPosition: (v) => [t.x[i] + 1.2 * v.dx, t.y[i] + 1.2 * v.dy], getColor: [255, 170, 0], getWidth: 3, widthUnits: 'pixels' }),
  ];
}

export function localizationLayers(D, ui) {
  const L = D.localization;
  if (!L) return [];
  const k = ui.step, t = D.trees, layers = [];
  if (L.truth) layers.push(new PathLayer({ id: 'truth', data: [L.truth], getPath: (p) => p, positionFormat: 'XY', getColor: ui.dark ? [220, 220, 220] : [0, 0, 0], getWidth: 1, widthUnits: 'pixels', opacity: 0.6 }));
  layers.push(new ScatterplotLayer({
    id: 'trail', data: { length: k + 1 }, getPosition: (_, { index }) => (Number.isFinite(L.x[index]) ? [L.x[index], L.y[index]] : [1e9, 1e9]), getRadius: 2, radiusUnits: 'pixels',
    getFillColor: (_, { index }) => COLORS[L.states[L.state[index]]], updateTriggers: { getPosition: k },
  }));
  const from = L.hypStart[k], to = L.hypStart[k + 1];
  if (to > from)
    layers.push(new ScatterplotLayer({
      id: 'hypotheses', data: { length: to - from }, getPosition: (_, { index }) => [L.hypX[from + index], L.hypY[from + index]], getRadius: (_, { index }) => 4 + 8 * Math.sqrt(L.hypW[from + index]),
      radiusUnits: 'pixels', getFillColor: (_, { index }) => [...COLORS.ambiguous, 70 + 180 * L.hypW[from + index]], stroked: true, getLineColor: [120, 80, 0], lineWidthUnits: 'pixels', getLineWidth: 1, updateTriggers: { getPosition: k, getRadius: k, getFillColor: k },
    }));
  if (Number.isFinite(L.x[k])) {
    const here = [L.x[k], L.y[k]], yaw = L.yaw[k], c = Math.cos(yaw), s = Math.sin(yaw), size = 14 / 2 ** ui.zoom;
    const at = (u, v) => [here[0] + size * (c * u - s * v), here[1] + size * (s * u + c * v)];
    const seen = [];
    for (let j = L.seenStart[k]; j < L.seenStart[k + 1]; j++) seen.push(L.seen[j]);
    layers.push(new LineLayer({ id: 'seen', data: seen, getSourcePosition: () => here, getTargetPosition: (i) => [t.x[i], t.y[i]], getColor: [...COLORS.tracking, 150], getWidth: 1.5, widthUnits: 'pixels' }));
    layers.push(new PathLayer({ id: 'sigma', data: [0], getPath: () => ring(here[0], here[1], 2.45 * ui.times * L.sigmaA[k], 2.45 * ui.times * L.sigmaB[k], L.rowAngle), _pathType: 'loop', getColor: COLORS.degraded, getWidth: 2, widthUnits: 'pixels' }));
    layers.push(new SolidPolygonLayer({ id: 'robot', data: [0], getPolygon: () => [at(1, 0), at(-0.7, 0.6), at(-0.35, 0), at(-0.7, -0.6)], getFillColor: COLORS[L.states[L.state[k]]] }));
  }
  return layers;
}
