// A camera path of views that were kept, its preview, and files of the place.

import { reach } from './reach.js';

const COUNT_MS = 500, STARTS = 0.12, FEWEST = 2, MOST = 60, COLOUR = [0.94, 0.76, 0.45, 0.9], TURN = 2 * Math.PI;
const ENDINGS = { 'gaussians.glb': 'glb', mp4: 'mp4', spz: 'spz', ply: 'ply', glb: 'glb', png: 'png' };
const round = (value) => Math.round(value * 1000) / 1000;

/** The view [x, y, z, heading, pitch] at a share of a smooth path, from rest to rest, as `glide` of export_space.py has it. */
export function glideAt(views, share) {
  const slow = 2 * STARTS * (1 - STARTS), rest = 1 - share, last = views.length - 1;
  const at = last * (share < STARTS ? share ** 2 / slow : rest < STARTS ? 1 - rest ** 2 / slow : (share - STARTS / 2) / (1 - STARTS));
  const first = Math.min(Math.floor(at), last - 1), t = at - first;
  const [before, from, to, after] = [-1, 0, 1, 2].map((k) => views[Math.min(last, Math.max(0, first + k))]);
  return from.map((value, a) => (2 * t ** 3 - 3 * t ** 2 + 1) * value + ((t ** 3 - 2 * t ** 2 + t) * (to[a] - before[a])) / 2
    + (3 * t ** 2 - 2 * t ** 3) * to[a] + ((t ** 3 - t ** 2) * (after[a] - value)) / 2);
}

export class Film {
  /** panel: its parts are named by data-film and data-file; on: eye(), stand(view), picture() -> promise of a blob, unsaved(), expose(stops),
   * redraw(), say(text), name, kept (under which name the browser keeps the path), address, drawn (the address that counts pictures), command, key. */
  constructor(panel, on) {
    Object.assign(this, { panel, on, views: [], playing: 0, open: false });
    const part = (name) => panel.querySelector(`[data-film=${name}]`);
    this.parts = Object.fromEntries(['views', 'add', 'preview', 'seconds', 'exposure', 'stops', 'state'].map((name) => [name, part(name)]));
    this.parts.add.onclick = () => this.add();
    this.parts.preview.onclick = () => this.preview();
    this.parts.exposure.oninput = () => this.expose();
    this.parts.exposure.ondblclick = () => { this.parts.exposure.value = 0; this.expose(); this.keep(); };
    panel.querySelectorAll('[data-file]').forEach((button) => {
      button.hidden = !on.address && button.dataset.file !== 'png';
      button.onclick = () => this.download(button.dataset.file, button);
    });
    this.parts.exposure.onpointerup = () => this.parts.exposure.blur();  // else the arrow keys would go on moving it
    this.recall();
    for (const kind of ['pointerdown', 'keydown']) addEventListener(kind, (event) => { if (!event.target.closest?.('[data-film=preview]')) this.stop(); });
    this.show();
  }

  /** Takes the path and the exposure that this browser kept of the place. */
  recall() {
    try {
      const { views, seconds, stops } = JSON.parse(localStorage.getItem(this.on.kept)), numbers = (view) => view.length === 5 && view.every(Number.isFinite);
      this.views = views.filter(numbers).slice(0, MOST);
      this.parts.seconds.value = Number(seconds) || 8;
      this.parts.exposure.value = Number(stops) || 0;
      this.expose();
    } catch { /* nothing kept, or a browser that keeps nothing */ }
    this.parts.exposure.onchange = () => this.keep();
    this.parts.seconds.onchange = () => { this.parts.seconds.value = this.seconds; this.keep(); };
  }

  keep() {
    try { localStorage.setItem(this.on.kept, JSON.stringify({ views: this.views, seconds: this.seconds, stops: this.stops })); } catch { /* it is lost with the page then */ }
  }

  toggle(open = !this.open) {
    this.open = open;
    this.panel.hidden = !open;
    this.on.redraw();
  }

  get stops() { return Number(this.parts.exposure.value); }

  get seconds() { return Math.min(120, Math.max(1, Number.isNaN(parseFloat(this.parts.seconds.value)) ? 8 : parseFloat(this.parts.seconds.value))); }

  add() {
    if (this.views.length >= MOST) { this.on.say(`A path has ${MOST} views at most.`); return; }
    const { place, heading, pitch } = this.on.eye();
    this.views.push([...place, heading, pitch]);
    this.keep();
    if (!this.open) this.on.say(`View ${this.views.length} of the camera path is kept; X shows the path.`);
    this.show();
  }

  /** The views with headings that turn the shorter way. */
  get path() {
    let heading = this.views[0]?.[3] ?? 0;
    return this.views.map(([x, y, z, h, pitch]) => {
      heading += ((((h - heading + Math.PI) % TURN) + TURN) % TURN) - Math.PI;
      return [x, y, z, heading, pitch];
    });
  }

  /** The view at a share of the path. */
  at(share) { return glideAt(this.path, share); }

  preview() {
    if (this.playing) { this.stop(); return; }
    if (this.views.length < FEWEST) { this.on.say('Keep two views or more: walk on, and press K.'); return; }
    const path = this.path, began = performance.now(), { seconds } = this;
    const step = (now) => {
      const share = Math.min(1, Math.max(0, now - began) / (1000 * seconds));
      this.on.stand(glideAt(path, share));
      this.playing = share < 1 ? requestAnimationFrame(step) : 0;
      if (!this.playing) this.show();
    };
    this.playing = requestAnimationFrame(step);
    this.show();
  }

  stop() {
    if (!this.playing) return;
    cancelAnimationFrame(this.playing);
    this.playing = 0;
    this.show();
  }

  expose() {
    this.parts.stops.textContent = `${this.stops > 0 ? '+' : ''}${this.stops.toFixed(1)}`;
    this.on.expose(this.stops);
  }

  async download(kind, button) {
    if (kind === 'mp4' && this.filming) { this.filming.abort(); return; }
    if (kind !== 'png' && this.on.unsaved()) { this.on.say('Files are of the saved place; save the edits first.'); return; }
    if (kind === 'mp4' && this.views.length < FEWEST) { this.on.say('A film needs a path: keep two views or more (K).'); return; }
    const degrees = (angle) => round((angle * 180) / Math.PI), path = this.path.map(([x, y, z, heading, pitch]) => [...[x, y, z].map(round), degrees(heading), degrees(pitch)]);
    const wish = { kind, key: this.on.key, ...(kind === 'mp4' && { path, seconds: this.seconds, exposure: this.stops }) };
    const stop = new AbortController();
    if (kind === 'mp4') this.filming = stop; else button.disabled = true;
    this.parts.state.textContent = kind === 'mp4' ? `Drawing ${Math.round(30 * this.seconds)} pictures … MP4 again stops it.` : `Writing the ${button.textContent} …`;
    const counting = kind === 'mp4' ? setInterval(() => this.count(performance.now() - began), COUNT_MS) : 0, began = performance.now();
    try {
      const blob = kind === 'png' ? await this.on.picture() : await (await reach(this.on.address + location.search, this.on.command, { method: 'POST', body: JSON.stringify(wish), signal: stop.signal })).blob();
      const anchor = Object.assign(document.createElement('a'), { href: URL.createObjectURL(blob), download: `${this.on.name}.${ENDINGS[kind]}` });
      anchor.click();
      setTimeout(() => URL.revokeObjectURL(anchor.href), 10000);
      this.parts.state.textContent = `${anchor.download}: ${(blob.size / 1e6).toFixed(1)} MB`;
    } catch (error) {
      this.parts.state.textContent = stop.signal.aborted ? 'The film was stopped.' : '';
      if (!stop.signal.aborted) this.on.say(error.message);
    }
    clearInterval(counting);
    if (kind === 'mp4') this.filming = null; else button.disabled = false;
  }

  /** Shows how much of a film is drawn after `took` milliseconds. */
  async count(took) {
    try {
      const stop = this.filming, [done, total] = await (await reach(this.on.drawn + location.search, this.on.command, { method: 'POST' })).json();
      if (!done || stop !== this.filming) return;
      this.parts.state.textContent = `Drawing picture ${done + 1} of ${total}, ${Math.ceil(((total - done) / done) * took / 1000)} s left … MP4 again stops it.`;
    } catch { /* the film itself says what is wrong */ }
  }

  /** The path as lines. */
  get wires() {
    if (!this.open || this.playing || this.views.length < FEWEST) return [];
    const { path } = this, parts = 24 * (path.length - 1), points = Array.from({ length: parts + 1 }, (_, k) => glideAt(path, k / parts).slice(0, 3));
    return [{ points: new Float32Array(points.slice(1).flatMap((point, k) => [...points[k], ...point])), colour: COLOUR }];
  }

  show() {
    const { parts, views } = this;
    parts.views.replaceChildren(...views.map((view, at) => {
      const chip = document.createElement('span'), go = document.createElement('button'), drop = document.createElement('button');
      Object.assign(go, { textContent: at + 1, title: 'Go there', onclick: () => this.on.stand(view) });
      Object.assign(drop, { textContent: '×', title: 'Remove', ariaLabel: `Remove view ${at + 1}`, onclick: () => { this.views.splice(at, 1); this.keep(); this.show(); } });
      chip.append(go, drop);
      return chip;
    }));
    parts.preview.textContent = this.playing ? 'Stop' : 'Preview';
    this.on.redraw();
  }
}
