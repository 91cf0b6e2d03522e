// The map of a world's memory: its keyframes as small view cones, floors as tiles, the camera, and its path.

const COLOURS = [null, '#8fa3c4', '#7fe3c4', '#f0c274', '#4a5366'];
const NAMES = ['', 'recorded', 'observed', 'imagined', 'walkable'], WALKABLE = 4;
const NEAR_M = 40, LONGEST = 6000, STEPS = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20];

export class MemoryMap {
  constructor(root) {
    this.root = root;
    this.canvas = root.querySelector('canvas');
    this.clear();
  }

  clear() {
    Object.assign(this, { keys: [], path: [], camera: null, box: null, layer: null, step: -1, goal: null });
  }

  /** A chart event (see serve/protocol.py); `length` is how many steps are remembered of the way. */
  show({ step, camera, known, imagined, places }) {
    if (places) this.take(places);
    if (step < this.step) this.path = this.path.filter((place) => place.step <= step);
    const last = this.path[this.path.length - 1];
    const jumped = last && Math.hypot(camera[0] - last.x, camera[1] - last.y) > 3;  // a new episode, or it was set elsewhere
    if (!last || Math.hypot(camera[0] - last.x, camera[1] - last.y) > 0.05) this.path.push({ step, x: camera[0], y: camera[1], jumped });
    if (this.path.length > LONGEST) this.path.splice(0, LONGEST / 4);
    this.camera = camera;
    this.step = step;
    this.tell(known, imagined);
    this.draw();
  }

  take(flat) {
    this.keys = [];
    for (let at = 0; at < flat.length; at += 4) this.keys.push({ x: flat[at], y: flat[at + 1], heading: flat[at + 2], kind: flat[at + 3] });
    this.keys.sort((a, b) => a.kind - b.kind);
    this.layer = null;
    const counts = NAMES.map((name, kind) => [name, kind, this.keys.filter((key) => key.kind === kind).length]);
    document.getElementById('map-kinds').replaceChildren(...counts.filter(([name, , count]) => name && count).map(([name, kind, count]) =>
      Object.assign(document.createElement('span'), { className: `k${kind}`, textContent: `${count} ${name}` })));
  }

  tell(known, imagined) {
    const place = this.keys.length > 0 && this.keys.every(({ kind }) => kind === 4);  // a place has no views, only ground to walk on
    const text = known === null ? '' : `${Math.round(100 * known)}% ${place ? 'of the picture was observed' : 'from memory'}${imagined > 0.05 ? ` + ${Math.round(100 * imagined)}% invented earlier` : ''}`;
    const node = document.getElementById('map-known');
    node.title = place ? 'The rest of the picture is invented' : 'Shares of the picture. From memory: places that were recorded or observed. Invented earlier: places that the world made up before, and shows again. The rest is invented now.';
    if (node.textContent !== text) node.textContent = text;
  }

  /** The part of the world that the map shows: all places near the camera, and the camera. */
  fit(width, height, ratio) {
    const [x, y] = this.camera;
    let [x0, x1, y0, y1] = [x - 2, x + 2, y - 2, y + 2];
    for (const key of this.keys) {
      if (Math.hypot(key.x - x, key.y - y) > NEAR_M) continue;
      [x0, x1, y0, y1] = [Math.min(x0, key.x - 1), Math.max(x1, key.x + 1), Math.min(y0, key.y - 1), Math.max(y1, key.y + 1)];
    }
    const old = this.box, inset = 10 * ratio;
    if (old && old.width === width && x0 >= old.x0 - 0.01 && x1 <= old.x1 + 0.01 && y0 >= old.y0 - 0.01 && y1 <= old.y1 + 0.01
      && Math.max(x1 - x0, y1 - y0) > 0.5 * Math.max(old.x1 - old.x0, old.y1 - old.y0)) return;  // it fits still
    const grow = old ? 0.15 * Math.max(x1 - x0, y1 - y0) : 0;
    [x0, x1, y0, y1] = [x0 - grow, x1 + grow, y0 - grow, y1 + grow];
    const scale = Math.min((width - 2 * inset) / (x1 - x0), (height - 2 * inset) / (y1 - y0));
    this.box = { x0, x1, y0, y1, width, scale, x: width / 2 - (scale * (x0 + x1)) / 2, y: height / 2 + (scale * (y0 + y1)) / 2 };
    this.layer = null;
  }

  at(x, y) { return [this.box.x + this.box.scale * x, this.box.y - this.box.scale * y]; }  // x to the right, y up

  /** The place in the world at a place on the canvas, in CSS pixels: x and y in metres; null where there is no map yet. */
  place(u, v) {
    if (!this.box) return null;
    const ratio = this.canvas.width / this.canvas.clientWidth, { x, y, scale } = this.box;
    return [(u * ratio - x) / scale, (y - v * ratio) / scale].map((metres) => Math.round(1000 * metres) / 1000);
  }

  /** Where the agent is to go: a ring with a dot, and a faint line to it. */
  drawGoal(context, ratio) {
    const [u, v] = this.at(...this.goal), [x, y] = this.at(this.camera[0], this.camera[1]);
    context.strokeStyle = context.fillStyle = '#7fe3c4';
    context.lineWidth = 1.25 * ratio;
    context.globalAlpha = 0.5;
    context.setLineDash([2 * ratio, 4 * ratio]);
    context.beginPath();
    context.moveTo(x, y);
    context.lineTo(u, v);
    context.stroke();
    context.setLineDash([]);
    context.globalAlpha = 1;
    for (const [radius, fill] of [[7, false], [2.5, true]]) {
      context.beginPath();
      context.arc(u, v, radius * ratio, 0, 7);
      if (fill) context.fill(); else { context.lineWidth = 2 * ratio; context.stroke(); }
    }
  }

  /** What changes seldom: the ground, the places, the scale. */
  drawLayer(width, height, ratio) {
    this.layer = Object.assign(document.createElement('canvas'), { width, height });
    const context = this.layer.getContext('2d'), { scale } = this.box;
    context.fillStyle = '#0b0c0f';
    context.fillRect(0, 0, width, height);
    const reach = Math.max(4.5 * ratio, Math.min(0.9 * scale, 15 * ratio));
    for (const { x, y, heading, kind } of this.keys) {
      const [u, v] = this.at(x, y);
      if (u < -reach || u > width + reach || v < -reach || v > height + reach) continue;
      context.fillStyle = COLOURS[kind] ?? '#ffffff';
      if (kind === WALKABLE) {  // a tile of floor
        const side = 0.38 * scale;
        context.globalAlpha = 0.6;
        context.fillRect(u - side / 2, v - side / 2, side, side);
        continue;
      }
      context.globalAlpha = kind === 1 ? 0.16 : 0.42;
      context.beginPath();
      context.moveTo(u, v);
      context.arc(u, v, reach, -heading - 0.55, -heading + 0.55);
      context.fill();
      context.globalAlpha = kind === 1 ? 0.55 : 1;
      context.beginPath();
      context.arc(u, v, (kind === 1 ? 0.8 : 1.25) * ratio, 0, 7);
      context.fill();
    }
    context.globalAlpha = 1;
    const metres = STEPS.find((step) => step * scale > 26 * ratio) ?? 50, long = metres * scale;
    context.fillStyle = '#8d9097';
    context.fillRect(8 * ratio, height - 9 * ratio, long, ratio);
    context.font = `${10 * ratio}px ui-monospace, Menlo, Consolas, monospace`;
    context.fillText(`${metres} m`, 8 * ratio, height - 13 * ratio);
  }

  draw() {
    const ratio = Math.min(2, devicePixelRatio || 1), width = Math.round(this.canvas.clientWidth * ratio), height = Math.round(this.canvas.clientHeight * ratio);
    if (!this.camera || !width || !height) return;
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    this.fit(width, height, ratio);
    if (!this.layer || this.layer.width !== width) this.drawLayer(width, height, ratio);
    const context = this.canvas.getContext('2d', { alpha: false });
    context.drawImage(this.layer, 0, 0);
    context.strokeStyle = '#eceae4';
    context.lineWidth = 1.25 * ratio;
    context.lineJoin = context.lineCap = 'round';
    context.globalAlpha = 0.55;
    context.beginPath();
    for (const { x, y, jumped } of this.path) context[jumped ? 'moveTo' : 'lineTo'](...this.at(x, y));
    context.stroke();
    context.globalAlpha = 1;
    if (this.goal) this.drawGoal(context, ratio);
    const [u, v] = this.at(this.camera[0], this.camera[1]), size = 6.5 * ratio;
    context.save();
    context.translate(u, v);
    context.rotate(-this.camera[2]);
    const sight = context.createRadialGradient(0, 0, 0, 0, 0, size * 7);
    sight.addColorStop(0, '#ffffff66');
    sight.addColorStop(1, '#ffffff00');
    context.fillStyle = sight;
    context.beginPath();
    context.moveTo(0, 0);
    context.arc(0, 0, size * 7, -0.75, 0.75);
    context.fill();
    context.fillStyle = '#ffffff';
    context.strokeStyle = '#0b0c0f';
    context.lineWidth = 2 * ratio;
    context.beginPath();
    context.moveTo(size * 1.5, 0);
    context.lineTo(-size, -size * 0.85);
    context.lineTo(-size * 0.5, 0);
    context.lineTo(-size, size * 0.85);
    context.closePath();
    context.stroke();
    context.fill();
    context.restore();
  }
}
