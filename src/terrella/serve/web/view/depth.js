// Depth in colours: half floats become colours by a table of all 65,536 of them.

import { NEAR_FAR, NOTHING, paintRamp } from './colours.js';

/** The number that a half float's bits stand for. */
export function fromHalf(bits) {
  const sign = bits & 0x8000 ? -1 : 1, power = (bits >> 10) & 31, rest = bits & 1023;
  if (power === 31) return rest ? NaN : sign * Infinity;
  return sign * (power ? 2 ** (power - 15) * (1 + rest / 1024) : 2 ** -14 * (rest / 1024));
}

const tables = new Map();

function tableOf(near, far) {
  const key = `${near} ${far}`;
  if (!tables.has(key)) {
    const table = new Uint32Array(65536);
    for (let bits = 0; bits < 65536; bits++) {
      const depth = fromHalf(bits);
      const part = (depth - near) / (far - near);
      table[bits] = depth > 0 && Number.isFinite(depth) ? NEAR_FAR[Math.round(255 * Math.min(1, Math.max(0, part)))] : NOTHING;
    }
    if (tables.size > 8) tables.clear();
    tables.set(key, table);
  }
  return tables.get(key);
}

export const metres = (value) => (Math.abs(value) >= 9.995 ? value.toFixed(1) : value.toFixed(2));

export function makeDepth(figure, canvas) {
  const scale = Object.assign(document.createElement('div'), { className: 'scale' });
  const near = document.createElement('span'), far = document.createElement('span'), bar = document.createElement('canvas');
  const probe = Object.assign(document.createElement('div'), { className: 'probe', hidden: true });
  paintRamp(bar, NEAR_FAR);
  scale.append(near, far, bar);
  figure.append(scale, probe);
  let shown = null, pointer = null;
  const point = () => {
    probe.hidden = !shown || !pointer;
    if (probe.hidden) return;
    const x = Math.min(shown.width - 1, Math.floor(pointer.x * shown.width)), y = Math.min(shown.height - 1, Math.floor(pointer.y * shown.height));
    const depth = fromHalf(shown.half[y * shown.width + x]);
    probe.textContent = Number.isFinite(depth) ? `${metres(depth)} m` : 'nothing hit';
    probe.style.left = `${Math.min(.9, Math.max(.1, pointer.x)) * 100}%`;
    probe.style.top = `${Math.max(.2, pointer.y) * 100}%`;
  };
  canvas.onpointermove = (event) => { pointer = { x: event.offsetX / canvas.clientWidth, y: event.offsetY / canvas.clientHeight }; point(); };
  canvas.onpointerleave = () => { pointer = null; point(); };
  return (held) => {
    shown = held;
    if (canvas.width !== held.width || canvas.height !== held.height) Object.assign(canvas, { width: held.width, height: held.height });
    const image = new ImageData(held.width, held.height), pixels = new Uint32Array(image.data.buffer), table = tableOf(held.near, held.far);
    for (let at = 0; at < pixels.length; at++) pixels[at] = table[held.half[at]];
    canvas.getContext('2d').putImageData(image, 0, 0);
    near.textContent = `${metres(held.near)} m`;
    far.textContent = `${metres(held.far)} m`;
    point();
  };
}
