// Which Gaussians a camera sees, the nearest first: in a worker, by counting.

/** The worker's whole program: it is sent as text. It gets {means, scales} once and after edits, then one view after another. */
function sorting() {
  const BINS = 65536;
  let means = new Float32Array(0), reach = new Float32Array(0), depth = new Float32Array(0);
  const counts = new Uint32Array(BINS + 1);
  onmessage = ({ data }) => {
    if (data.means) {
      means = data.means;
      depth = new Float32Array(means.length / 3);
      reach = new Float32Array(depth.length);
      for (let k = 0; k < reach.length; k += 1) reach[k] = 3.34 * Math.max(data.scales[3 * k], data.scales[3 * k + 1], data.scales[3 * k + 2]);
      return;
    }
    const { eye, ahead, right, up, wide, tall, near, share = 1, id } = data, [ex, ey, ez] = eye, [ax, ay, az] = ahead, [rx, ry, rz] = right, [ux, uy, uz] = up;
    const across = Math.hypot(1, wide), high = Math.hypot(1, tall);
    let low = Infinity, most = -Infinity, shown = 0;
    for (let k = 0; k < depth.length; k += 1) {
      const x = means[3 * k] - ex, y = means[3 * k + 1] - ey, z = means[3 * k + 2] - ez, d = x * ax + y * ay + z * az;
      depth[k] = -1;
      if (((k * 40503) & 1023) >= share * 1024) continue;  // a part of them, the same ones each time
      if (d < near || Math.abs(x * rx + y * ry + z * rz) - wide * 1.02 * d > reach[k] * across || Math.abs(x * ux + y * uy + z * uz) - tall * 1.02 * d > reach[k] * high) continue;
      depth[k] = d;
      shown += 1;
      if (d < low) low = d;
      if (d > most) most = d;
    }
    const step = (BINS - 1) / Math.max(most - low, 1e-6), order = new Uint32Array(shown);
    counts.fill(0);
    for (let k = 0; k < depth.length; k += 1) if (depth[k] >= 0) counts[Math.floor((depth[k] - low) * step) + 1] += 1;
    for (let bin = 0; bin < BINS; bin += 1) counts[bin + 1] += counts[bin];
    for (let k = 0; k < depth.length; k += 1) if (depth[k] >= 0) order[counts[Math.floor((depth[k] - low) * step)]++] = k;
    postMessage({ order, share, id }, [order.buffer]);
  };
}

export class Sorter {
  constructor(onOrder) {
    const program = URL.createObjectURL(new Blob([`(${sorting})()`], { type: 'text/javascript' }));
    Object.assign(this, { worker: new Worker(program), busy: false, waiting: null, id: 0, oldest: 0 });
    this.worker.onmessage = ({ data }) => {
      this.busy = false;
      if (data.id >= this.oldest) onOrder(data.order, data.share);
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
