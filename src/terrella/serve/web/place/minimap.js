// The place from above: a picture of the Gaussians below the eye, and the eye in it.

const ABOVE = 0.35, STEPS = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50];

/** Between which x, and y, all but a few of the opaque Gaussians from one number to another lie; null: there are none. */
function middle({ means, opacities }, from, to) {
  const some = Array.from({ length: to - from }, (_, k) => from + k).filter((k) => opacities[k] > 0.3);
  return some.length ? [0, 1].flatMap((a) => {
    const sorted = Float32Array.from(some, (k) => means[3 * k + a]).sort();
    return [0.002, 0.998].map((share) => sorted[Math.round(share * (sorted.length - 1))]);
  }) : null;
}

export class MiniMap {
  /** source: the scene before its edits, whose ends the map keeps; what edits add widens them. */
  constructor(canvas, source) { Object.assign(this, { canvas, source, layer: null }); }

  /** The ends [x0, x1, y0, y1] of what the map shows. */
  ends(scene) {
    const { boxes, length } = this.source;
    this.own ??= boxes ? [0, 1].flatMap((a) => [Math.min(...boxes.map((one) => one[a])), Math.max(...boxes.map((one) => one[3 + a]))]) : middle(this.source, 0, length) ?? [0, 1, 0, 1];  // windows show what lies beyond walls
    const more = middle(scene, scene.before, scene.length) ?? this.own;
    return this.own.map((end, k) => (k % 2 ? Math.max(end, more[k]) + 0.3 : Math.min(end, more[k]) - 0.3));
  }

  /** Paints what lies below a height into a picture of its own. */
  take(scene, top) {
    const ratio = Math.min(2, devicePixelRatio || 1), width = Math.round(this.canvas.clientWidth * ratio), height = Math.round(this.canvas.clientHeight * ratio);
    if (!width || !height) return;
    const { means, scales, colours, opacities, length } = scene, some = [];
    for (let k = 0; k < length; k += 1) if (means[3 * k + 2] < top && opacities[k] > 0.3) some.push(k);
    const box = this.ends(scene), inset = 8 * ratio;
    const scale = Math.min((width - 2 * inset) / (box[1] - box[0]), (height - 2 * inset) / (box[3] - box[2]));
    Object.assign(this.canvas, { width, height });
    this.box = { scale, x: width / 2 - (scale * (box[0] + box[1])) / 2, y: height / 2 + (scale * (box[2] + box[3])) / 2 };
    const image = new ImageData(width, height), pixels = new Uint32Array(image.data.buffer), heights = new Float32Array(pixels.length).fill(-Infinity);
    for (const k of some) {
      if (means[3 * k] < box[0] || means[3 * k] > box[1] || means[3 * k + 1] < box[2] || means[3 * k + 1] > box[3]) continue;
      const [u, v] = this.at(means[3 * k], means[3 * k + 1]), wide = Math.min(5 * ratio, Math.max(0.7, scale * Math.max(scales[3 * k], scales[3 * k + 1])));
      const shade = (part) => Math.min(255, Math.max(0, 20 + 225 * colours[3 * k + part])), ink = (255 << 24 | shade(2) << 16 | shade(1) << 8 | shade(0)) >>> 0;
      for (let y = Math.max(0, Math.round(v - wide)); y <= Math.min(height - 1, v + wide); y += 1) for (let x = Math.max(0, Math.round(u - wide)); x <= Math.min(width - 1, u + wide); x += 1) {
        const at = y * width + x;
        if (heights[at] < means[3 * k + 2]) { heights[at] = means[3 * k + 2]; pixels[at] = ink; }
      }
    }
    this.layer = Object.assign(document.createElement('canvas'), { width, height });
    this.layer.getContext('2d').putImageData(image, 0, 0);
    this.ratio = ratio;
    this.top = top;
  }

  at(x, y) { return [this.box.x + this.box.scale * x, this.box.y - this.box.scale * y]; }

  /** The map with an eye {place, heading} in it. */
  draw(scene, { place, heading }, reach, eye) {
    const top = place[2] + ABOVE;
    if (!this.layer || Math.abs(top - this.top) > 0.8) this.take(scene, top - Math.min(0.2, eye / 4));
    if (!this.layer) return;
    const { canvas, ratio, box } = this, context = canvas.getContext('2d'), [u, v] = this.at(place[0], place[1]), size = 6 * ratio;
    context.clearRect(0, 0, canvas.width, canvas.height);
    context.drawImage(this.layer, 0, 0);
    const metres = STEPS.find((step) => step * box.scale > 26 * ratio) ?? 100;
    context.fillStyle = '#eceae4';
    context.fillRect(8 * ratio, canvas.height - 8 * ratio, metres * box.scale, 1.5 * ratio);
    context.font = `500 ${10 * ratio}px ui-monospace, Menlo, Consolas, monospace`;
    context.fillText(`${metres} m`, 8 * ratio, canvas.height - 13 * ratio);
    context.save();
    context.translate(u, v);
    context.rotate(-heading);
    const sight = context.createRadialGradient(0, 0, 0, 0, 0, size * 7);
    sight.addColorStop(0, '#ffffff88');
    sight.addColorStop(1, '#ffffff00');
    context.fillStyle = sight;
    context.beginPath();
    context.moveTo(0, 0);
    context.arc(0, 0, size * 7, -Math.atan(reach), Math.atan(reach));
    context.fill();
    Object.assign(context, { fillStyle: '#ffffff', strokeStyle: '#0b0c0f', lineWidth: 2 * ratio });
    context.beginPath();
    for (const [x, y] of [[1.5, 0], [-1, -0.85], [-0.5, 0], [-1, 0.85]]) context.lineTo(x * size, y * size);
    context.closePath();
    context.stroke();
    context.fill();
    context.restore();
  }
}
