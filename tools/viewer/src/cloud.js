// The clouds of one tree, from each side, in a small 3D view of its own.
import { Deck, OrbitView } from '@deck.gl/core';
import { PointCloudLayer, LineLayer } from '@deck.gl/layers';

const SIDES = [[27, 120, 55], [0, 114, 178], [230, 159, 0], [204, 121, 167], [86, 180, 233], [213, 94, 0], [0, 158, 115], [120, 120, 120]];
let deck = null;

export function showCloud(element, views, axis, side) {
  const parts = views.map((v, k) => ({ ...v, k })).filter((v) => side < 0 || v.k === side);
  const layers = parts.filter((v) => v.cloud && v.cloud.length).map((v) => new PointCloudLayer({
    id: `side${v.k}`, data: { length: v.cloud.length / 3 }, getPosition: (_, { index }) => [v.cloud[3 * index] / 1000, v.cloud[3 * index + 1] / 1000, v.cloud[3 * index + 2] / 1000],
    getColor: SIDES[v.k % SIDES.length], pointSize: 3, sizeUnits: 'pixels', material: false,
  }));
  layers.push(new LineLayer({ id: 'axis', data: [axis], getSourcePosition: () => [0, 0, 0], getTargetPosition: (a) => [1.6 * a[0], 1.6 * a[1], 1.6 * a[2]], getColor: [255, 170, 0], getWidth: 2, widthUnits: 'pixels' }));
  if (deck && deck.props.parent !== element) { deck.finalize(); deck = null; }
  if (!deck) {
    deck = new Deck({
      parent: element, width: '100%', height: '100%', views: new OrbitView({ orbitAxis: 'Z', fovy: 40 }), controller: true,
      initialViewState: { target: [0, 0, 0.8], rotationX: 12, rotationOrbit: 30, zoom: 6.6, minZoom: 3, maxZoom: 11 }, layers,
    });
  } else deck.setProps({ layers });
}

export const sideColor = (k) => `rgb(${SIDES[k % SIDES.length].join(',')})`;
