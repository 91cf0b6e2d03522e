// Two places in one picture, from the same camera: the other one to the left of a line that can be dragged, the place to its right.

import { Sorter } from './sort.js';

const $ = (id) => document.getElementById(id), STEP = 0.02;

export class Compare {
  /** drawingOn(canvas): what draws on a canvas. */
  constructor(redraw, drawingOn) {
    Object.assign(this, { redraw, drawingOn, open: false, at: 0.5, db: null, name: '' });
    const line = $('wipe');
    line.onpointerdown = (event) => { line.setPointerCapture(event.pointerId); event.preventDefault(); };
    line.onpointermove = (event) => line.hasPointerCapture(event.pointerId) && this.wipe(event.clientX / innerWidth);
    line.onkeydown = (event) => {
      const by = { ArrowLeft: -STEP, ArrowRight: STEP }[event.key];
      if (by) { event.stopPropagation(); this.wipe(this.at + by); }
    };
  }

  /** Shows a scene beside the place's own; null: no more. */
  show(scene, name = this.name) {
    Object.assign(this, { open: !!scene, name, db: null });
    $('compare').hidden = !scene;
    $('compared').setAttribute('aria-pressed', this.open);
    if (scene) {
      this.drawing ??= this.drawingOn($('other'));
      if (!this.drawing.soft) this.sorter ??= new Sorter(({ order, coarse }) => { this.drawing.order(order, coarse); this.redraw(); });
      this.drawing.set(scene, 1);
      this.sorter?.set(scene);
      $('other-name').textContent = name;
      this.wipe(this.at);
    }
    this.redraw();
  }

  wipe(at) {
    this.at = Math.min(1, Math.max(0, at));
    const percent = `${(100 * this.at).toFixed(2)}%`;
    $('other').style.clipPath = `inset(0 calc(100% - ${percent}) 0 0)`;
    $('wipe').style.left = percent;
    $('wipe').setAttribute('aria-valuenow', Math.round(100 * this.at));
  }

  get ready() { return !this.open || this.drawing.ready; }

  get busy() { return this.open && !!(this.sorter ?? this.drawing).busy; }

  ask(view) { if (this.open) this.sorter.ask(view); }

  /** Paints what is compared with as `ours`, the place's own drawing, was painted; at rest it says how far apart both are. */
  paint(ours, view, part, rests) {
    if (!this.open) return;
    const canvas = $('other'), [, , width, height] = part;
    if (!ours.soft && (canvas.width !== width || canvas.height !== height)) Object.assign(canvas, { width, height });
    Object.assign(this.drawing, { tint: ours.tint, stops: ours.stops });
    this.drawing.clear();
    this.drawing.paint(view, part);
    this.db = rests && !this.busy ? decibels(read(ours, part), read(this.drawing, part)) : null;
    $('compare-db').textContent = this.db === null ? '–' : this.db === Infinity ? 'the same' : `${this.db.toFixed(1)} dB`;
  }
}

function read(drawing, [x, y, width, height]) {
  if (drawing.soft) return drawing.read();
  const { gl } = drawing, data = new Uint8Array(4 * width * height);
  gl.readPixels(x, y, width, height, gl.RGBA, gl.UNSIGNED_BYTE, data);
  return data;
}

/** The peak signal-to-noise ratio of two pictures in RGBA, of their colours. */
function decibels(one, other) {
  let sum = 0;
  for (let at = 0; at < one.length; at += 4) for (let part = 0; part < 3; part += 1) sum += (one[at + part] - other[at + part]) ** 2;
  return sum ? 10 * Math.log10((255 * 255 * 0.75 * one.length) / sum) : Infinity;
}
