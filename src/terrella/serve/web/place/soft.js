// Draws Gaussians without a graphics card: workers go through them from near to far, as space/raster does. It stands in for Drawing.

import { covariance } from './draw.js';

const WORKERS = 2, FAST_MS = 60, SLOW_MS = 85, COARSEST = 0.2, PAST = 3, FAINT = 3.5, WHOLE = 9;  // exponents at which a Gaussian ends, on the way and at rest

/** A worker's whole program: it is sent as text. It gets a scene's rows, then flags, then one view after another.
 * A row, of one cache line: place 3, covariance 6, colour 3, opacity, the exponent at which it ends, reach, flags. */
function rastering() {
  const BINS = 65536, BLOCK = 4, SPENT = 1 / 255, STEPS = 256, MOST = 5.6, GROUND = [11, 12, 15];
  const falls = Float32Array.from({ length: STEPS * MOST + 2 }, (_, k) => Math.exp(-(k + 0.5) / STEPS)), bins = new Uint32Array(BINS + 1);
  let rows = new Float32Array(0), depth = null, near = null, order = null, paint = null;

  /** Which Gaussians lie before the eye and within its view, nearest first, in `order`; returns their number. */
  function sorted({ view: m, projection, preview }, moved) {
    const wide = 1 / projection[0], tall = 1 / projection[5], across = Math.hypot(1, wide), upright = Math.hypot(1, tall), factor = preview.factor;
    let many = 0, low = Infinity, high = 0;
    for (let k = 0; k < rows.length; k += 16) {
      if (rows[k + 12] <= SPENT) continue;
      let x = rows[k], y = rows[k + 1], z = rows[k + 2], far = rows[k + 14];
      if (rows[k + 15] & 2) { [x, y, z] = moved(x, y, z); far *= factor; }
      const d = -(m[2] * x + m[6] * y + m[10] * z + m[14]);
      if (d < 0.05 || Math.abs(m[0] * x + m[4] * y + m[8] * z + m[12]) - wide * d > far * across || Math.abs(m[1] * x + m[5] * y + m[9] * z + m[13]) - tall * d > far * upright) continue;
      near[many] = k;
      depth[many++] = d;
      if (d < low) low = d;
      if (d > high) high = d;
    }
    const step = (BINS - 1) / Math.max(high - low, 1e-6);
    bins.fill(0);
    for (let at = 0; at < many; at += 1) bins[((depth[at] - low) * step | 0) + 1] += 1;
    for (let bin = 0; bin < BINS; bin += 1) bins[bin + 1] += bins[bin];
    for (let at = 0; at < many; at += 1) order[bins[(depth[at] - low) * step | 0]++] = near[at];
    return many;
  }

  function draw(asked) {
    const { view: m, projection, width, height, tint, gain, stands, preview, cut } = asked;
    const fx = (projection[0] * width) / 2, fy = (projection[5] * height) / 2, limits = [1.3 / projection[0], 1.3 / projection[5]];
    const c = preview.factor * Math.cos(preview.turn), s = preview.factor * Math.sin(preview.turn), [mx, my, mz] = preview.middle, [ox, oy, oz] = preview.move;
    const moved = (x, y, z) => [c * (x - mx) - s * (y - my) + mx + ox, s * (x - mx) + c * (y - my) + my + oy, preview.factor * (z - mz) + mz + oz];
    const many = sorted(asked, moved), blocks = Math.ceil(width / (1 << BLOCK)), total = width * height;
    if (paint?.length !== 4 * total) paint = new Float32Array(4 * total);
    const left = new Int32Array(blocks * Math.ceil(height / (1 << BLOCK)));  // how many pixels of each block something shows through
    for (let y = 0; y < height; y += 1) for (let x = 0; x < blocks; x += 1) left[(y >> BLOCK) * blocks + x] += Math.min(1 << BLOCK, width - (x << BLOCK));
    /** Whether something shows through in a part of the picture. */
    const open = (x0, x1, y0, y1) => {
      const from = Math.max(0, x0) >> BLOCK, to = Math.min(width - 1, x1) >> BLOCK, last = Math.min(height - 1, y1) >> BLOCK;
      for (let row = Math.max(0, y0) >> BLOCK; row <= last; row += 1) for (let column = from; column <= to; column += 1) if (left[row * blocks + column]) return true;
      return false;
    };
    paint.fill(0);
    for (let at = 3; at < paint.length; at += 4) paint[at] = 1;
    for (let at = 0; at < many; at += 1) {
      const k = order[at], marked = rows[k + 15] & 2;
      let x = rows[k], y = rows[k + 1], z = rows[k + 2], xx = rows[k + 3], xy = rows[k + 4], xz = rows[k + 5], yy = rows[k + 6], yz = rows[k + 7], zz = rows[k + 8];
      if (marked) {
        [x, y, z] = moved(x, y, z);
        [xx, xy, yy, xz, yz, zz] = [c * c * xx - 2 * c * s * xy + s * s * yy, c * s * (xx - yy) + (c * c - s * s) * xy, s * s * xx + 2 * c * s * xy + c * c * yy, preview.factor * (c * xz - s * yz), preview.factor * (s * xz + c * yz), preview.factor ** 2 * zz];
      }
      const ahead = -(m[2] * x + m[6] * y + m[10] * z + m[14]), ex = (m[0] * x + m[4] * y + m[8] * z + m[12]) / ahead, ey = (m[1] * x + m[5] * y + m[9] * z + m[13]) / ahead;
      const u = width / 2 + fx * ex - 0.5, v = height / 2 - fy * ey - 0.5, sx = Math.max(-limits[0], Math.min(limits[0], ex)), sy = Math.max(-limits[1], Math.min(limits[1], ey));
      const gx = fx / ahead, gy = fy / ahead, far = rows[k + 14] * (marked ? preview.factor : 1) * (1 + Math.abs(sx) + Math.abs(sy)) * Math.max(gx, gy) + 2;
      if (!open(u - far, u + far, v - far, v + far)) continue;
      const a0 = gx * (m[0] + sx * m[2]), a1 = gx * (m[4] + sx * m[6]), a2 = gx * (m[8] + sx * m[10]), b0 = gy * (m[1] + sy * m[2]), b1 = gy * (m[5] + sy * m[6]), b2 = gy * (m[9] + sy * m[10]);
      const ax = xx * a0 + xy * a1 + xz * a2, ay = xy * a0 + yy * a1 + yz * a2, az = xz * a0 + yz * a1 + zz * a2;
      const p = stands * (ax * a0 + ay * a1 + az * a2) + 0.3, q = -stands * (ax * b0 + ay * b1 + az * b2);
      const r = stands * (b0 * (xx * b0 + 2 * xy * b1 + 2 * xz * b2) + b1 * (yy * b1 + 2 * yz * b2) + zz * b2 * b2) + 0.3;
      const opacity = rows[k + 12], most = Math.min(cut, rows[k + 13]), wide = Math.sqrt(2 * most * p), tall = Math.sqrt(2 * most * r), det = p * r - q * q;
      const x0 = Math.max(0, Math.ceil(u - wide)), x1 = Math.min(width - 1, Math.floor(u + wide)), y0 = Math.max(0, Math.ceil(v - tall)), y1 = Math.min(height - 1, Math.floor(v + tall));
      if (x0 > x1 || y0 > y1 || !(det > 0)) continue;
      const A = (0.5 * r) / det, B = -q / det, C = (0.5 * p) / det, unseen = rows[k + 15] & 1;
      let red = rows[k + 9], green = rows[k + 10], blue = rows[k + 11];
      if (tint) {
        const grey = 0.3 * red + 0.59 * green + 0.11 * blue;
        [red, green, blue] = unseen ? [0.38 * grey + 0.583, 0.38 * grey + 0.471, 0.38 * grey + 0.279] : [0.663 * grey + 0.0935, 0.663 * grey + 0.1664, 0.663 * grey + 0.144];
      }
      if (marked) [red, green, blue] = [0.5 * red + 0.31, 0.5 * green + 0.505, 0.5 * blue + 0.445];
      for (let j = y0; j <= y1; j += 1) {
        const dy = j - v, base = C * dy * dy, lean = B * dy, row = (j >> BLOCK) * blocks;
        for (let i = x0; i <= x1; i += 1) {
          const here = 4 * (j * width + i), through = paint[here + 3];
          if (through < SPENT) continue;
          const dx = i - u, power = base + dx * (lean + A * dx);
          if (power >= most) continue;
          let alpha = opacity * falls[power * STEPS | 0];
          if (alpha > 0.99) alpha = 0.99;
          const share = alpha * through, rest = through - share;
          paint[here] += share * red;
          paint[here + 1] += share * green;
          paint[here + 2] += share * blue;
          paint[here + 3] = rest;
          if (rest < SPENT) left[row + (i >> BLOCK)] -= 1;
        }
      }
    }
    const pixels = new Uint8ClampedArray(4 * total);
    for (let at = 0; at < pixels.length; at += 4) {
      const through = paint[at + 3];
      for (let part = 0; part < 3; part += 1) pixels[at + part] = 255 * gain * paint[at + part] + through * GROUND[part];
      pixels[at + 3] = 255;
    }
    return pixels;
  }

  onmessage = ({ data }) => {
    if (data.rows) {
      const many = data.rows.length / 16;
      [rows, depth, near, order] = [data.rows, new Float32Array(many), new Uint32Array(many), new Uint32Array(many)];
    } else if (data.flags) data.flags.forEach((flag, k) => { rows[16 * k + 15] = flag; });
    else {
      const began = performance.now(), pixels = draw(data);
      postMessage({ id: data.id, pixels, width: data.width, height: data.height, ms: performance.now() - began }, [pixels.buffer]);
    }
  };
}

export class Soft {
  /** arrived(): a picture is there; failed(): a worker could not draw one. */
  constructor(canvas, arrived, failed) {
    const program = URL.createObjectURL(new Blob([`(${rastering})()`], { type: 'text/javascript' })), still = { middle: [0, 0, 0], move: [0, 0, 0], turn: 0, factor: 1 };
    Object.assign(this, { canvas, arrived, failed, context: canvas.getContext('2d', { alpha: false }), soft: true, count: 0, stands: 1, tint: 0, stops: 0, still, preview: still });
    Object.assign(this, { share: 0.5, ms: FAST_MS, id: 0, shown: 0, asked: '', next: null, picture: null, wires: [], view: null, version: 0 });
    this.workers = Array.from({ length: WORKERS }, () => {
      const one = { worker: new Worker(program), free: true };
      one.worker.onmessage = ({ data }) => this.take(one, data);
      one.worker.onerror = () => this.lose(one);
      return one;
    });
  }

  /** Whether a worker is free. */
  get ready() { return this.workers.some(({ free }) => free); }

  /** Whether the newest view is still being drawn. */
  get busy() { return !!this.next || this.shown < this.id; }

  set(scene, stands = 1) {
    const rows = new Float32Array(16 * scene.length), { means, colours, opacities } = scene;
    for (let k = 0; k < scene.length; k += 1) {
      const at = 16 * k, spread = covariance(scene, k);
      rows.set(means.subarray(3 * k, 3 * k + 3), at);
      rows.set(spread, at + 3);
      rows.set(colours.subarray(3 * k, 3 * k + 3), at + 9);
      rows.set([opacities[k], Math.log(255 * opacities[k]), 3.34 * Math.sqrt(stands * (spread[0] + spread[3] + spread[5]))], at + 12);
    }
    this.workers.forEach(({ worker }) => worker.postMessage({ rows }));
    Object.assign(this, { stands, count: scene.length });
    this.mark(scene, null);
  }

  mark(scene, mask) {
    const flags = Uint8Array.from(scene.seen, (seen, k) => (seen ? 0 : 1) | (mask?.[k] ? 2 : 0));
    this.workers.forEach(({ worker }) => worker.postMessage({ flags }));
    this.version += 1;
  }

  clear() {}

  /** Asks for a view, coarser while the eye `moves`; of several that are wished for while the workers draw, the last is drawn. */
  paint({ view, projection, moves }, [, , width, height], wires = []) {
    const share = moves ? this.share : 1, wish = { view, projection, width: Math.round(share * width), height: Math.round(share * height), tint: this.tint, gain: 2 ** (this.stops / 2.2), stands: this.stands, preview: this.preview, moves, cut: moves ? FAINT : WHOLE };
    const asked = JSON.stringify([wish, this.version]);
    this.wires = wires;
    if (asked === this.asked) { this.present(); return; }
    Object.assign(this, { asked, next: wish });
    this.send();
  }

  send() {
    const one = this.workers.find(({ free }) => free);
    if (!one || !this.next) return;
    Object.assign(one, { free: false, view: this.next, id: ++this.id });
    one.worker.postMessage({ ...this.next, id: one.id });
    this.next = null;
  }

  take(one, { id, pixels, width, height, ms }) {
    one.free = true;
    this.send();
    if (id < this.shown) return;  // one that was asked later came first
    if (one.view.moves) this.adapt(ms);
    Object.assign(this, { shown: id, view: one.view, picture: new ImageData(pixels, width, height) });
    this.present();
    this.arrived();
  }

  /** A worker had an error, of too little memory perhaps: what is shown stays, and the next view is tried. */
  lose(one) {
    one.free = true;
    Object.assign(this, { shown: Math.max(this.shown, one.id ?? 0), asked: '' });
    this.failed();
    this.send();
  }

  /** The pictures on the way are as large as the workers draw in time. */
  adapt(ms) {
    this.ms += (ms - this.ms) / PAST;
    if (this.ms > SLOW_MS || this.ms < FAST_MS) Object.assign(this, { share: Math.max(COARSEST, Math.min(1, this.share * (this.ms > SLOW_MS ? 0.88 : 1.06))), ms: (FAST_MS + SLOW_MS) / 2 });
  }

  present() {
    const { context, canvas, view: shown, picture } = this;
    if (!picture) return;
    const { width, height } = picture;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    context.putImageData(picture, 0, 0);
    const ends = (at) => {
      const m = shown.view, p = shown.projection, [x, y, d] = [0, 1, 2].map((a) => m[a] * at[0] + m[4 + a] * at[1] + m[8 + a] * at[2] + m[12 + a]);
      return d < -0.05 && [(width / 2) * (1 - (p[0] * x) / d), (height / 2) * (1 + (p[5] * y) / d)];
    };
    for (const { points, colour } of this.wires) {
      context.strokeStyle = `rgba(${colour.slice(0, 3).map((part) => 255 * part).join()},${colour[3]})`;
      context.beginPath();
      for (let at = 0; at < points.length; at += 6) {
        const from = ends(points.subarray(at, at + 3)), to = ends(points.subarray(at + 3, at + 6));
        if (from && to) { context.moveTo(...from); context.lineTo(...to); }
      }
      context.stroke();
    }
  }

  /** The picture as it is shown, rows from below as WebGL reads them. */
  read() {
    const { width, height } = this.canvas, { data } = this.context.getImageData(0, 0, width, height), rows = new Uint8Array(data.length);
    for (let y = 0; y < height; y += 1) rows.set(data.subarray(4 * y * width, 4 * (y + 1) * width), 4 * (height - 1 - y) * width);
    return rows;
  }
}

/** Whether this browser draws without a graphics card. */
export function drawsInSoftware() {
  const gl = document.createElement('canvas').getContext('webgl2'), named = gl?.getExtension('WEBGL_debug_renderer_info'), text = gl && `${gl.getParameter(named?.UNMASKED_RENDERER_WEBGL ?? gl.RENDERER)}`;
  gl?.getExtension('WEBGL_lose_context')?.loseContext();
  return !gl || /swiftshader|llvmpipe|softpipe|software|basic render/i.test(text);
}
