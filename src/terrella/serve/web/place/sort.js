// The Gaussians that a camera sees, nearest first, far ones thinned out: a counting sort in a worker.

/** The worker's whole program: it is sent as text. It gets {means, scales} once and after edits, then one view after another. */
function sorting() {
  const BINS = 65536, RINGS = 512, NEAREST = 0.05, FARTHEST = 2000, octave = (RINGS - 1) / Math.log(FARTHEST / NEAREST);
  const ringOf = (metres) => Math.max(0, Math.min(RINGS - 1, Math.floor(octave * Math.log(metres / NEAREST))));
  let away = new Float32Array(0), means = new Float32Array(0), reach = new Float32Array(0), depth = new Float32Array(0);
  const counts = new Uint32Array(BINS + 1), rings = new Float64Array(RINGS);

  /** How far all can be drawn, and beyond it a share that falls with the square of the distance, without being more than `most`. */
  function reachFor(most) {
    let beyond = 0, nearer = 0, within = NEAREST;
    const radius = (ring) => NEAREST * Math.exp(ring / octave);
    for (let ring = 0; ring < RINGS; ring += 1) beyond += rings[ring] / radius(ring + 0.5) ** 2;
    for (let ring = 0; ring < RINGS; ring += 1) {
      nearer += rings[ring];
      beyond -= rings[ring] / radius(ring + 0.5) ** 2;
      if (nearer + beyond * radius(ring + 1) ** 2 > most) return within;
      within = radius(ring + 1);
    }
    return Infinity;
  }

  onmessage = ({ data }) => {
    if (data.means) {
      means = data.means;
      depth = new Float32Array(means.length / 3);
      away = new Float32Array(depth.length);
      reach = new Float32Array(depth.length);
      for (let k = 0; k < reach.length; k += 1) reach[k] = 3.34 * Math.max(data.scales[3 * k], data.scales[3 * k + 1], data.scales[3 * k + 2]);
      return;
    }
    const { eye, ahead, right, up, wide, tall, near, most = Infinity, id } = data, [ex, ey, ez] = eye, [ax, ay, az] = ahead, [rx, ry, rz] = right, [ux, uy, uz] = up;
    const across = Math.hypot(1, wide), upright = Math.hypot(1, tall);
    let low = Infinity, high = -Infinity, shown = 0, all = 0;
    rings.fill(0);
    for (let k = 0; k < depth.length; k += 1) {
      const x = means[3 * k] - ex, y = means[3 * k + 1] - ey, z = means[3 * k + 2] - ez, d = x * ax + y * ay + z * az;
      depth[k] = -1;
      if (d < near || Math.abs(x * rx + y * ry + z * rz) - wide * 1.02 * d > reach[k] * across || Math.abs(x * ux + y * uy + z * uz) - tall * 1.02 * d > reach[k] * upright) continue;
      depth[k] = d;
      away[k] = x * x + y * y + z * z;
      all += 1;
      if (most < Infinity) rings[ringOf(Math.sqrt(away[k]))] += 1;
    }
    const within = all > most ? reachFor(most) : Infinity;
    for (let k = 0; k < depth.length; k += 1) {
      if (depth[k] < 0) continue;
      if (((k * 40503) & 1023) * away[k] >= 1024 * within * within) { depth[k] = -1; continue; }  // the same ones each time
      shown += 1;
      if (depth[k] < low) low = depth[k];
      if (depth[k] > high) high = depth[k];
    }
    const step = (BINS - 1) / Math.max(high - low, 1e-6), order = new Uint32Array(shown);
    counts.fill(0);
    for (let k = 0; k < depth.length; k += 1) if (depth[k] >= 0) counts[Math.floor((depth[k] - low) * step) + 1] += 1;
    for (let bin = 0; bin < BINS; bin += 1) counts[bin + 1] += counts[bin];
    for (let k = 0; k < depth.length; k += 1) if (depth[k] >= 0) order[counts[Math.floor((depth[k] - low) * step)]++] = k;
    postMessage({ order, within, all, id }, [order.buffer]);
  };
}

export class Sorter {
  constructor(onOrder) {
    const program = URL.createObjectURL(new Blob([`(${sorting})()`], { type: 'text/javascript' }));
    Object.assign(this, { onOrder, worker: new Worker(program), busy: false, waiting: null, id: 0, oldest: 0 });
    this.worker.onmessage = ({ data }) => {
      this.busy = false;
      if (data.id >= this.oldest) this.onOrder(data);
      if (this.waiting) this.ask(this.waiting);
    };
  }

  set(scene) {
    const means = scene.means.slice();
    this.oldest = this.id + 1;  // orders of the scene before are not drawn
    this.worker.postMessage({ means, scales: scene.scales }, [means.buffer]);
  }

  ask(view) {
    this.waiting = this.busy ? view : null;
    if (this.busy) return;
    this.busy = true;
    this.worker.postMessage({ ...view, id: ++this.id });
  }
}
