// The tracks: one time axis for all; a lane for each sensor with a tick for each reading, and its numbers as lines.

import { AMBER, AURORA, EMBER, FAINT, MUTE, lineColour } from './colours.js';
import { indexAt } from './library.js';

const TICKS = 6, MONO = 'ui-monospace, "SF Mono", Menlo, Consolas, monospace';  // TICKS: height of a plot's own ticks
const SHOWN_AT_FIRST = 8, MOST_COLUMNS = 64;
const off = new Set();  // lines switched off, "sensor number", kept from episode to episode
const on = new Set();

export class Tracks {
  /** hooks: seek(time), step(place) when a sensor is chosen to step by. */
  constructor(root, hooks) {
    this.root = root;
    this.hooks = hooks;
    this.ruler = root.querySelector('#timeline canvas');
    this.lanes = [];
    this.from = 0;
    this.to = 1;
    this.#scrub(this.ruler);
    for (const event of ['wheel']) root.addEventListener(event, (e) => this.#wheel(e), { passive: false });
    new ResizeObserver(() => this.draw()).observe(root);
  }

  open(episode, stepper) {
    this.episode = episode;
    [this.from, this.to] = [0, Math.max(episode.seconds, 1e-3)];
    this.lanes = episode.sensors.filter((sensor) => !sensor.absent).map((sensor) => this.#lane(sensor));
    if (episode.language.length) this.lanes.unshift(this.#words(episode.language));
    this.root.querySelector('#lanes').replaceChildren(...this.lanes.map((lane) => lane.element));
    this.setStepper(stepper);
    this.draw();
  }

  setStepper(place) {
    for (const lane of this.lanes) lane.element.classList.toggle('clock-of', !!lane.sensor && lane.sensor.place === place);
  }

  #element(name, rate) {
    const element = Object.assign(document.createElement('div'), { className: 'lane' }), label = Object.assign(document.createElement('div'), { className: 'label' });
    const head = Object.assign(document.createElement('div'), { className: 'head' }), canvas = document.createElement('canvas');
    const title = document.createElement('b'), small = document.createElement('small');
    title.textContent = name;
    small.textContent = rate;
    head.append(title, small);
    label.append(head);
    element.append(label, canvas);
    this.#scrub(canvas);
    return { element, label, head, canvas };
  }

  #words(language) {
    const lane = this.#element('language', '');
    lane.element.style.height = '24px';
    lane.draw = (context, width, height) => {
      context.font = '500 11.5px Inter, system-ui, sans-serif';
      language.forEach(([time, text], at) => {
        const x = Math.max(0, this.x(time, width)), stop = this.x(language[at + 1]?.[0] ?? this.episode.seconds, width);
        if (stop < 0 || x > width) return;
        context.fillStyle = at % 2 ? '#7fe3c414' : '#7fe3c424';
        context.fillRect(x, 3, Math.max(1, stop - x - 1), height - 6);
        context.save();
        context.beginPath();
        context.rect(x, 0, stop - x - 4, height);
        context.clip();
        context.fillStyle = '#bfe9db';
        context.fillText(text, x + 7, height / 2 + 4);
        context.restore();
      });
    };
    return lane;
  }

  #lane(sensor) {
    const rate = sensor.fault ? 'fault' : sensor.period ? `${tidyRate(1 / sensor.period)} Hz` : `${sensor.count} ×`;
    const lane = Object.assign(this.#element(sensor.label, rate), { sensor });
    lane.head.title = sensor.fault || [sensor.name, sensor.frame && `frame ${sensor.frame}`, sensor.rate_hz && `nominally ${tidyRate(sensor.rate_hz)} Hz`, `${sensor.count} readings`].filter(Boolean).join(' · ');
    if (sensor.count) { lane.element.classList.add('steps'); lane.head.onclick = () => this.hooks.step(sensor.place); }
    if (sensor.kind !== 'vector' || sensor.fault) {
      lane.element.style.height = '22px';
      lane.draw = (context, width, height) => drawTicks(context, this, sensor, width, 6, height - 12);
      return lane;
    }
    this.#legend(lane, sensor);
    lane.draw = sensor.dtype === 'bool' ? (...all) => this.#drawFlags(lane, ...all) : (...all) => this.#drawLines(lane, ...all);
    return lane;
  }

  #legend(lane, sensor) {
    const names = sensor.names.slice(0, MOST_COLUMNS), only = names.length === 1 && names[0] === '0';
    const legend = Object.assign(document.createElement('div'), { className: names.length < 3 ? 'legend one' : 'legend' });
    lane.cells = names.map((name, column) => {
      const key = `${sensor.name} ${column}`, button = document.createElement('button'), word = document.createElement('span'), value = document.createElement('b');
      if (column >= SHOWN_AT_FIRST && !on.has(key)) off.add(key);
      word.textContent = only ? 'value' : name;
      button.title = [name, sensor.units[column]].filter(Boolean).join(', ') + ': click to hide or show, double-click to show it alone';
      button.style.setProperty('--own', lineColour(column));
      button.append(word, value);
      const flip = (show) => { (show ? off : on).delete(key); (show ? on : off).add(key); };
      button.onclick = () => { flip(off.has(key)); lane.update(); this.drawLane(lane); };
      button.ondblclick = () => {
        names.forEach((_, other) => { const its = `${sensor.name} ${other}`; (other === column ? off : on).delete(its); (other === column ? on : off).add(its); });
        lane.update();
        this.drawLane(lane);
      };
      return { button, value, key, unit: sensor.units[column] ?? '' };
    });
    lane.update = () => lane.cells.forEach(({ button, key }) => button.setAttribute('aria-pressed', !off.has(key)));
    lane.update();
    legend.append(...lane.cells.map(({ button }) => button));
    lane.label.append(legend);
    const narrow = matchMedia('(max-width: 700px)').matches, lines = Math.min(narrow ? 4 : 6, Math.ceil(names.length / (names.length < 3 || narrow ? 1 : 2)));
    lane.element.style.height = `${Math.max(sensor.dtype === 'bool' ? 40 : 56, 26 + 16 * lines)}px`;
    if (sensor.names.length > MOST_COLUMNS) lane.head.title += ` · the first ${MOST_COLUMNS} of ${sensor.names.length} numbers`;
  }

  // -- time and place ------------------------------------------------------------------------------------------------

  x(time, width) {
    return ((time - this.from) / (this.to - this.from)) * width;
  }

  zoom(factor, around) {
    const whole = Math.max(this.episode.seconds, 1e-3), span = Math.min(whole, Math.max((this.to - this.from) * factor, whole / 5000, 1e-3));
    const part = (around - this.from) / (this.to - this.from);
    this.#show(around - part * span, span);
  }

  fit() {
    this.#show(0, Math.max(this.episode.seconds, 1e-3));
  }

  /** Moves the window so that `time` is in it. */
  reveal(time) {
    const span = this.to - this.from;
    if (time < this.from - 1e-9 || time > this.to + 1e-9) this.#show(time - span * 0.1, span);
  }

  #show(from, span) {
    const whole = Math.max(this.episode.seconds, 1e-3);
    this.from = Math.min(Math.max(0, from), whole - span);
    this.to = this.from + span;
    this.draw();
    this.place();
  }

  #scrub(canvas) {
    const at = (event) => {
      const box = canvas.getBoundingClientRect(), part = Math.min(1, Math.max(0, (event.clientX - box.left) / box.width));
      this.hooks.seek(this.from + part * (this.to - this.from));
    };
    canvas.addEventListener('pointerdown', (event) => { if (!this.episode) return; canvas.setPointerCapture(event.pointerId); at(event); });
    canvas.addEventListener('pointermove', (event) => { if (this.episode && canvas.hasPointerCapture(event.pointerId)) at(event); });
  }

  #wheel(event) {
    if (!this.episode || !event.target.matches('canvas')) return;
    const box = event.target.getBoundingClientRect(), span = this.to - this.from;
    if (event.ctrlKey || event.metaKey || event.target === this.ruler) {
      event.preventDefault();
      this.zoom(Math.exp(event.deltaY * 0.003), this.from + ((event.clientX - box.left) / box.width) * span);
    } else if (event.shiftKey || Math.abs(event.deltaX) > Math.abs(event.deltaY)) {
      event.preventDefault();
      this.#show(this.from + ((event.deltaX || event.deltaY) / box.width) * span, span);
    }
  }

  // -- drawing -------------------------------------------------------------------------------------------------------

  draw() {
    if (!this.episode) return;
    paint(this.ruler, (...all) => this.#drawRuler(...all));
    for (const lane of this.lanes) this.drawLane(lane);
  }

  drawLane(lane) {
    paint(lane.canvas, lane.draw);
  }

  /** Redraws what waits for a sensor's series. */
  arrived(place) {
    for (const lane of this.lanes) if (lane.sensor?.place === place && lane.waiting) this.drawLane(lane);
  }

  place(time = this.time ?? 0) {
    this.time = time;
    const head = this.root.querySelector('#playhead'), width = this.ruler.clientWidth, x = this.x(time, width);
    head.hidden = x < -1 || x > width + 1;
    head.style.transform = `translateX(${x}px)`;
    const height = this.root.querySelector('#lanes').offsetHeight + this.ruler.clientHeight;
    if (this.headHeight !== height) head.style.height = `${(this.headHeight = height)}px`;
  }

  /** Writes each sensor's own numbers at the playhead into its legend. */
  write(time) {
    for (const { sensor, cells } of this.lanes) {
      if (!cells) continue;
      const index = indexAt(sensor.times, time), numbers = index < 0 ? null : this.episode.numbers(sensor.place, index);
      if (numbers === undefined) continue;
      cells.forEach(({ value, unit }, column) => {
        const text = numbers ? tidyNumber(numbers[column], sensor.dtype) + (unit && cells.length < 3 ? ` ${unit}` : '') : '–';
        if (value.textContent !== text) value.textContent = text;
      });
    }
  }

  #drawRuler(context, width, height) {
    const span = this.to - this.from, steps = [0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 1800, 3600, 7200];
    const step = steps.find((second) => (second / span) * width > 84) ?? 14400, digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
    context.font = `10.5px ${MONO}`;
    for (let n = Math.ceil(this.from / (step / 5) - 1e-6); n * (step / 5) <= this.to + 1e-9; n++) {
      const x = this.x((n * step) / 5, width), whole = n % 5 === 0;
      context.fillStyle = whole ? '#5b5f67' : '#2c3037';
      context.fillRect(Math.round(x), height - (whole ? 8 : 5), 1, whole ? 8 : 5);
      if (!whole) continue;
      context.fillStyle = MUTE;
      context.textAlign = x < 20 ? 'left' : x > width - 24 ? 'right' : 'center';
      context.fillText(clock((n * step) / 5, digits), x, height - 12);
    }
    const whole = Math.max(this.episode.seconds, 1e-3);
    const zoomed = span < whole * 0.999;
    if (zoomed) {  // where in the episode this is
      context.fillStyle = '#24272d';
      context.fillRect(0, 0, width, 2);
      context.fillStyle = AURORA;
      context.fillRect((this.from / whole) * width, 0, Math.max(2, (span / whole) * width), 2);
    }
    this.root.querySelector('#zoom').textContent = zoomed ? `${(whole / span).toFixed(1)}× · 0 shows all` : '';
  }

  #curve(lane, width) {
    const buckets = Math.min(2048, Math.max(256, 256 * Math.ceil(width / 256)));
    const found = this.episode.curve(lane.sensor.place, this.from, this.to, buckets);
    lane.waiting = !found;
    if (found) lane.last = found;
    return found ?? lane.last;
  }

  #drawFlags(lane, context, width, height) {
    drawTicks(context, this, lane.sensor, width, height - TICKS - 2, TICKS);
    const curve = this.#curve(lane, width);
    if (!curve || curve.error) return;
    const rows = Math.min(curve.k, lane.cells.length), high = (height - TICKS - 8) / rows;
    for (let column = 0; column < rows; column++) {
      if (off.has(lane.cells[column].key)) continue;
      context.fillStyle = /done|terminated|truncated/.test(lane.sensor.name) ? EMBER : lineColour(column);
      for (let row = 0; row < curve.n; row++) {
        if (!(curve.high[row * curve.k + column] > 0)) continue;
        const x = this.x(curve.times[row], width), next = row + 1 < curve.n ? this.x(curve.times[row + 1], width) : x + 3;
        const wide = Math.max(rows > 1 ? 1 : 3, Math.min(next - x, 40));
        context.fillRect(Math.min(x, width - wide), 4 + column * high, wide, Math.max(2, high - 2));
      }
    }
  }

  #drawLines(lane, context, width, height) {
    const { sensor } = lane, curve = this.#curve(lane, width), top = 6, foot = height - TICKS - 8;
    if (curve && lane.cells.length > 1 && isFlags(curve)) return this.#drawFlags(lane, context, width, height);
    drawTicks(context, this, sensor, width, height - TICKS - 2, TICKS);
    if (!curve) return;
    if (curve.error) { context.fillStyle = AMBER; context.font = '12px system-ui'; context.fillText(curve.error, 8, height / 2); return; }
    const columns = lane.cells.map((_, column) => column).filter((column) => column < curve.k && !off.has(lane.cells[column].key));
    let [low, high] = [Infinity, -Infinity];
    for (const column of columns) {
      for (let at = column; at < curve.n * curve.k; at += curve.k) {
        if (Number.isFinite(curve.low[at]) && curve.low[at] < low) low = curve.low[at];
        if (Number.isFinite(curve.high[at]) && curve.high[at] > high) high = curve.high[at];
      }
    }
    if (low > high) return;
    if (high - low < 1e-12) [low, high] = [low - Math.max(Math.abs(low), 1) * .5, high + Math.max(Math.abs(high), 1) * .5];
    const y = (value) => foot - ((value - low) / (high - low)) * (foot - top);
    if (low < 0 && high > 0) { context.fillStyle = '#ffffff14'; context.fillRect(0, Math.round(y(0)), width, 1); }
    const gap = 5 * sensor.period;
    for (const column of columns) {
      context.strokeStyle = context.fillStyle = lineColour(column);
      context.lineWidth = 1.25;
      context.globalAlpha = curve.exact ? 1 : .9;
      context.beginPath();
      let before = NaN;
      for (let row = 0; row < curve.n; row++) {
        const at = row * curve.k + column, time = curve.times[row], x = this.x(time, width);
        if (!Number.isFinite(curve.low[at])) { before = NaN; continue; }
        const joined = time - before <= Math.max(gap, curve.exact ? 0 : ((this.to - this.from) / width) * 4);
        context[joined ? 'lineTo' : 'moveTo'](x, y(curve.low[at]));
        if (!joined && curve.exact) context.rect(x - .6, y(curve.low[at]) - .6, 1.2, 1.2), context.moveTo(x, y(curve.low[at]));
        if (!curve.exact) context.lineTo(x, y(curve.high[at]));
        before = time;
      }
      context.stroke();
      context.globalAlpha = 1;
    }
    context.font = `10px ${MONO}`;
    context.textAlign = 'right';
    for (const [value, at] of [[high, top + 7], [low, foot]]) {
      const text = tidyNumber(value, sensor.dtype), wide = context.measureText(text).width;
      context.fillStyle = '#0b0c0ff2';
      context.fillRect(width - wide - 8, at - 9, wide + 8, 12);
      context.fillStyle = FAINT;
      context.fillText(text, width - 3, at);
    }
    context.textAlign = 'left';
  }
}

/** Whether a vector is but keys held or let go: noughts and ones. */
function isFlags(curve) {
  curve.flags ??= !curve.error && curve.n > 0 && [curve.low, curve.high].every((values) => values.every((value) => value === 0 || value === 1));
  return curve.flags;
}

/** One mark for each reading; where they are too dense, a band, with gaps left open and marked in amber. */
function drawTicks(context, axis, sensor, width, top, height) {
  const { times, period } = sensor, first = Math.max(0, indexAt(times, axis.from)), last = indexAt(times, axis.to);
  const close = ((period / (axis.to - axis.from)) * width) < 3.5;
  context.fillStyle = sensor.kind === 'vector' ? '#ffffff33' : '#7fe3c4b0';
  let begun = null;
  for (let at = first; at <= last; at++) {
    const x = axis.x(times[at], width), gap = period && at > first && times[at] - times[at - 1] > 2.5 * period;
    if (!close) context.fillRect(Math.round(x), top, 1, height);
    else if (begun === null) begun = x;
    if (gap) {
      const left = axis.x(times[at - 1], width);
      const own = context.fillStyle;
      if (close) { context.globalAlpha = .6; context.fillRect(begun, top, Math.max(1, left - begun), height); context.globalAlpha = 1; begun = x; }
      context.fillStyle = AMBER;
      context.globalAlpha = .7;
      context.fillRect(left + 1, top + height / 2 - .5, Math.max(1, x - left - 2), 1);
      context.globalAlpha = 1;
      context.fillStyle = own;
    }
  }
  if (close && begun !== null) { context.globalAlpha = .6; context.fillRect(begun, top, Math.max(1, axis.x(times[last], width) - begun), height); context.globalAlpha = 1; }
}

function paint(canvas, draw) {
  const ratio = Math.min(2, devicePixelRatio || 1), width = canvas.clientWidth, height = canvas.clientHeight;
  if (!width || !height) return;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) Object.assign(canvas, { width: Math.round(width * ratio), height: Math.round(height * ratio) });
  const context = canvas.getContext('2d');
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  draw(context, width, height);
}

const tidyRate = (rate) => (rate >= 9.95 ? Math.round(rate) : rate.toPrecision(2));

export function tidyNumber(value, dtype = '') {
  if (dtype === 'bool') return value ? 'yes' : 'no';
  if (!Number.isFinite(value)) return Number.isNaN(value) ? 'NaN' : value > 0 ? '∞' : '−∞';
  const size = Math.abs(value), text = Number.isInteger(value) && size < 1e6 ? String(value) : size >= 1e5 || (size < 1e-3 && size) ? value.toExponential(1) : value.toFixed(size >= 100 ? 1 : size >= 10 ? 2 : 3);
  return text.replace('-', '−');
}

export function clock(seconds, digits) {
  if (seconds < 60) return `${seconds.toFixed(digits)}${digits ? '' : ' s'}`;
  const minutes = Math.floor(seconds / 60), rest = (seconds - 60 * minutes).toFixed(digits);
  return `${minutes}:${rest.padStart(digits ? digits + 3 : 2, '0')}`;
}
