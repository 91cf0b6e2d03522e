// The map of a flat world: its pictures stitched by how they scrolled, with a frame around the current one.

const EASE_MS = 260, LOOSE = 0.7, ROUND = 3, MORE = 1.2;

export class MosaicMap {
  constructor(root) {
    this.canvas = root.querySelector('canvas');
    this.known = root.querySelector('#map-known');
    this.kinds = root.querySelector('#map-kinds');
    this.clear();
  }

  clear() {
    this.turn = (this.turn ?? 0) + 1;
    Object.assign(this, { step: -1, beyond: false, picture: null, size: null, view: null, from: null, goal: null, moved: 0 });
  }

  /** A chart event (see serve/protocol.py) of a flat world; tells whether anything but the picture of now was seen. */
  async show({ step, mosaic }) {
    this.step = step;
    if (!mosaic) return this.beyond;
    const turn = this.turn += 1;
    const [image, mask] = await Promise.all([bitmap(mosaic.image, 'image/jpeg'), bitmap(mosaic.mask, 'image/png')]);
    if (turn === this.turn) this.take(mosaic, masked(image, mask));
    image.close();
    mask.close();
    return this.beyond;
  }

  take({ size, view }, picture) {
    Object.assign(this, { size, view, picture });
    this.beyond ||= size[0] > MORE * view[0] || size[1] > MORE * view[1];
    const goal = [Math.max(size[0] / 2, view[0]), Math.max(size[1] / 2, 0.75 * view[1])];
    const fits = this.goal?.every((half, at) => goal[at] <= half + 0.5 && goal[at] >= LOOSE * half);
    if (!fits) Object.assign(this, { from: this.goal ? this.half() : goal, goal, moved: performance.now() });
    this.tell(this.beyond ? '' : 'Nothing else seen yet');
    this.draw();
  }

  tell(text) {
    if (this.known.textContent !== text) this.known.textContent = text;
    if (this.kinds.childElementCount) this.kinds.replaceChildren();
  }

  /** Half of what the map shows across and down, in pixels of the world, on its way to what was seen. */
  half() {
    const part = Math.min(1, (performance.now() - this.moved) / EASE_MS), eased = part * part * (3 - 2 * part);
    return this.goal.map((goal, at) => this.from[at] + (goal - this.from[at]) * eased);
  }

  draw() {
    if (!this.picture || !this.canvas.clientWidth) return;
    const [across, down] = this.half();
    if (performance.now() < this.moved + EASE_MS) requestAnimationFrame(() => this.draw());
    this.canvas.style.height = `${Math.round((this.canvas.clientWidth * down) / across)}px`;  // at most what the style allows
    const ratio = Math.min(2, devicePixelRatio || 1), width = Math.round(this.canvas.clientWidth * ratio), height = Math.round(this.canvas.clientHeight * ratio);
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    const context = this.canvas.getContext('2d', { alpha: false }), scale = Math.min(width / across, height / down) / 2;
    context.fillStyle = '#0b0c0f';
    context.fillRect(0, 0, width, height);
    const place = ([wide, tall]) => [width / 2 - (scale * wide) / 2, height / 2 - (scale * tall) / 2, scale * wide, scale * tall];
    context.imageSmoothingEnabled = scale < 2;
    context.imageSmoothingQuality = 'high';
    context.save();
    context.globalAlpha = 0.7;  // what is not seen now is a memory
    context.shadowColor = '#7fe3c455';
    context.shadowBlur = 9 * ratio;
    context.drawImage(this.picture, ...place(this.size));
    context.restore();
    const frame = place(this.view);
    context.save();
    context.beginPath();
    context.roundRect(...frame, ROUND * ratio);
    context.clip();
    context.drawImage(this.picture, ...place(this.size));
    context.restore();
    for (const [colour, line] of [['#0b0c0fb0', 4], ['#ffffff', 1.5]]) {
      context.strokeStyle = colour;
      context.lineWidth = line * ratio;
      context.beginPath();
      context.roundRect(...frame, ROUND * ratio);
      context.stroke();
    }
  }
}

function bitmap(base64, type) {
  return createImageBitmap(new Blob([Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0))], { type }));
}

/** The image where the mask is not clear, as a canvas. */
function masked(image, mask) {
  const canvas = Object.assign(document.createElement('canvas'), { width: image.width, height: image.height }), context = canvas.getContext('2d');
  context.drawImage(image, 0, 0);
  context.globalCompositeOperation = 'destination-in';
  context.drawImage(mask, 0, 0);
  return canvas;
}
