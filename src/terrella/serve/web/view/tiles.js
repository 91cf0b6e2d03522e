// The tiles: one for each camera, depth, cloud and map, all of one height, as large as they fit.

import { indexAt } from './library.js';
import { makeDepth } from './depth.js';
import { makeMap } from './map.js';
import { makePoints } from './points.js';

const GAP = 10;

export class Tiles {
  constructor(root, changed) {
    this.root = root;
    this.all = [];
    this.alone = null;  // the one tile shown
    this.first = null;  // the one shown large
    this.changed = changed;
    new ResizeObserver(() => { this.layout(); changed(); }).observe(root);
  }

  get shown() {
    return this.alone ? [this.alone] : this.all;
  }

  open(episode) {
    this.episode = episode;
    const [alone, first] = [this.alone?.key, this.first?.key];
    this.all = episode.sensors.filter((sensor) => ['image', 'depth', 'points'].includes(sensor.kind) && !sensor.absent).map((sensor) => this.#make(sensor));
    this.all.push(...episode.sensors.filter((sensor) => sensor.pose && !sensor.absent && !sensor.fault).map((sensor) => this.#makeMap(sensor)));
    this.alone = this.all.find((tile) => tile.key === alone) ?? null;
    this.first = this.all.find((tile) => tile.key === first) ?? null;
    this.root.replaceChildren(...this.all.map((tile) => tile.figure));
    this.layout();
  }

  #figure(kind, label, aspect, key) {
    const figure = document.createElement('figure'), canvas = document.createElement('canvas'), caption = document.createElement('figcaption');
    const name = document.createElement('span'), at = document.createElement('small');
    figure.dataset.kind = kind;
    name.textContent = label;
    caption.append(name, at);
    figure.append(canvas, caption);
    const tile = { figure, canvas, caption: at, aspect, key, kind };
    caption.title = 'Show it large';
    caption.onclick = () => { this.first = tile; this.layout(); this.changed(); };
    figure.ondblclick = () => { this.alone = this.alone === tile ? null : tile; this.layout(); this.changed(); };
    return tile;
  }

  #make(sensor) {
    const [height, width] = sensor.kind === 'points' ? [3, 4] : sensor.shape;
    const aspect = Math.min(3, Math.max(0.4, width / height || 4 / 3));
    const tile = Object.assign(this.#figure(sensor.kind, sensor.label, aspect, sensor.name), { sensor, painted: -2 });
    if (sensor.fault) tile.figure.append(Object.assign(document.createElement('p'), { className: 'why', textContent: sensor.fault }));
    const paintBitmap = ({ bitmap }) => {
      if (tile.canvas.width !== bitmap.width || tile.canvas.height !== bitmap.height) Object.assign(tile.canvas, { width: bitmap.width, height: bitmap.height });
      tile.canvas.getContext('2d').drawImage(bitmap, 0, 0);
    };
    tile.paint = { image: () => paintBitmap, depth: makeDepth, points: makePoints }[sensor.kind](tile.figure, tile.canvas);
    return tile;
  }

  #makeMap(sensor) {
    const tile = this.#figure('map', `map · ${sensor.label}`, 1.15, `map ${sensor.name}`);
    const draw = makeMap(tile.canvas, sensor.pose);
    tile.drawAt = (time) => {
      const index = indexAt(sensor.times, time);
      draw(this.episode.curve(sensor.place, 0, this.episode.seconds, 1024, true), index < 0 ? undefined : this.episode.numbers(sensor.place, index), time);
    };
    return tile;
  }

  /** The arrangement that covers most: rows of one height, or the first tile large with rows of the others beside it. */
  layout() {
    const width = this.root.clientWidth, height = this.root.clientHeight;
    for (const tile of this.all) tile.figure.hidden = !this.shown.includes(tile);
    if (!this.shown.length || !width || !height) return;
    const [first, ...rest] = [...this.shown].sort((a, b) => (b === this.first) - (a === this.first));
    const even = this.#best([first, ...rest], 0, width, height), plans = [even];
    for (let high = height; rest.length > 1 && high > height / 2; high -= height / 24) {
      const wide = first.aspect * high, others = this.#best(rest, wide + GAP, width - wide - GAP, height);
      if (others.high < 0.6 * even.high || others.high > 0.8 * high) continue;
      const top = (height - high) / 2;
      plans.push({ area: others.area + wide * high, places: [[first, 0, top, high], ...others.places] });
    }
    const plan = plans.reduce((best, other) => (other.area > best.area * 1.05 ? other : best));
    const left = Math.min(...plan.places.map(([, x]) => x)), right = Math.max(...plan.places.map(([tile, x, , high]) => x + tile.aspect * high));
    for (const [tile, x, y, high] of plan.places) {
      tile.width = Math.floor(tile.aspect * high);
      Object.assign(tile.figure.style, { left: `${Math.round(x - left + (width - right + left) / 2)}px`, top: `${Math.round(y)}px`, width: `${tile.width}px`, height: `${Math.floor(high)}px` });
      tile.figure.classList.toggle('crisp', ['image', 'depth'].includes(tile.kind) && tile.width > 2.5 * (tile.sensor.shape[1] || 1));
    }
  }

  /** The tiles in rows of one height, as high as goes into a box: {high, area, places: [tile, x, y, high]}. */
  #best(shown, left, width, height) {
    let best = null;
    for (let count = 1; width > 0 && count <= shown.length; count++) {
      const rows = this.#rows(shown, count);
      const wide = Math.min(...rows.map((row) => (width - GAP * (row.length - 1)) / row.reduce((sum, tile) => sum + tile.aspect, 0)));
      const high = Math.min(wide, (height - GAP * (rows.length - 1)) / rows.length);
      if (high > (best?.high ?? 0)) best = { rows, high };
    }
    if (!best) return { high: 0, area: 0, places: [] };
    const { rows, high } = best, places = [];
    const widths = rows.map((row) => row.reduce((sum, tile) => sum + tile.aspect * high + GAP, -GAP)), widest = Math.max(...widths);
    rows.forEach((row, number) => {
      let x = left + (widest - widths[number]) / 2;
      for (const tile of row) {
        places.push([tile, x, (height - rows.length * (high + GAP) + GAP) / 2 + number * (high + GAP), high]);
        x += tile.aspect * high + GAP;
      }
    });
    return { high, area: places.reduce((sum, [tile]) => sum + tile.aspect * high * high, 0), places };
  }

  #rows(shown, count) {
    const total = shown.reduce((sum, tile) => sum + tile.aspect, 0), rows = [[]];
    let sum = 0;
    for (const tile of shown) {
      if (rows.length < count && rows.at(-1).length && sum + tile.aspect / 2 > (total * rows.length) / count) rows.push([]);
      rows.at(-1).push(tile);
      sum += tile.aspect;
    }
    return rows;
  }

  /** Whether every tile has what is due at `time`. */
  ready(time) {
    return this.shown.every((tile) => {
      if (!tile.sensor || tile.sensor.fault) return true;
      const index = indexAt(tile.sensor.times, time);
      return index < 0 || !!this.episode.reading(tile.sensor.place, index);
    });
  }

  draw(time) {
    for (const tile of this.shown) {
      if (tile.drawAt) { tile.drawAt(time); continue; }
      if (tile.sensor.fault) continue;
      this.#drawReading(tile, indexAt(tile.sensor.times, time), time);
    }
  }

  #drawReading(tile, index, time) {
    const { sensor } = tile;
    if (index < 0) {
      tile.caption.textContent = sensor.count ? 'nothing yet' : 'no readings';
      tile.canvas.style.visibility = 'hidden';
      tile.painted = -2;
      return;
    }
    const held = this.episode.reading(sensor.place, index);
    if (held && tile.painted !== index) {
      tile.figure.querySelector('.why')?.remove();
      tile.canvas.style.visibility = held.error ? 'hidden' : 'visible';
      if (held.error) tile.figure.append(Object.assign(document.createElement('p'), { className: 'why', textContent: held.error }));
      else tile.paint(held);
      tile.painted = index;
    }
    if (tile.painted < 0) return;
    const seen = sensor.times[tile.painted], age = time - seen, old = sensor.period && age > 2.2 * sensor.period;
    tile.caption.textContent = old ? `${age.toFixed(2)} s old` : `${seen.toFixed(3)} s`;
    tile.caption.classList.toggle('old', !!old);
  }

  /** What the tiles need from `time` on, most urgent first: [place, index, pixels across]. */
  needs(time, speed, playing) {
    const wanted = [], ratio = Math.min(2, devicePixelRatio || 1);
    for (const tile of this.shown) {
      if (!tile.sensor || tile.sensor.fault || !tile.sensor.count) continue;
      const { times, place, period } = tile.sensor, across = Math.ceil((tile.width * ratio) / 128) * 128;
      const add = (index, due) => { if (index >= 0 && index < times.length) wanted.push([due, place, index, across]); };
      const first = indexAt(times, time);
      add(first, 0);
      if (!playing) {
        for (const near of [1, -1, 2, -2]) add(first + near, 10 + Math.abs(near));
        continue;
      }
      const stride = Math.max(period, speed / 60), ahead = Math.min(24, Math.ceil((speed * 1.2) / (stride || 1)));
      for (let step = 1; step <= ahead; step++) {
        const index = stride > period ? indexAt(times, time + step * stride) : first + step;
        add(index, (times[index] ?? Infinity) - time);
      }
    }
    return wanted.sort((a, b) => a[0] - b[0]).map(([, ...rest]) => rest);
  }
}
