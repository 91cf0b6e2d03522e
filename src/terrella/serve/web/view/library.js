// The data of the server, fetched once and cached: the list, an episode's times and series, and its readings ahead of need.

import { reach } from '../place/reach.js';

const AT_ONCE = 5;  // requests for readings under way
const KEPT_BYTES = 320e6;  // of decoded readings

const query = () => {
  const token = new URLSearchParams(location.search).get('token');
  return token ? `token=${encodeURIComponent(token)}` : '';
};

let command = '';  // what starts the server

const ask = (path, options) => reach(`${path}${path.includes('?') ? '&' : '?'}${query()}`, command, options);

const post = (path, body) => ask(path, { method: 'POST', headers: { 'Content-Type': 'application/json' }, body: JSON.stringify(body) });

export async function about() {
  const facts = await (await ask('/about')).json();
  ({ command } = facts);
  return facts;
}
export const mark = async (episode, bad) => (await (await post('/mark', { episode, bad })).json()).bad;
export const startExport = async () => (await post('/export', {})).json();
export const exportStatus = async () => (await ask('/export')).json();

/** Index of the last reading at or before `time`, -1 where there is none yet. */
export function indexAt(times, time) {
  let low = 0, high = times.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] <= time + 1e-9) low = middle + 1; else high = middle;
  }
  return low - 1;
}

/** The usual time between readings: the median of those between neighbours (of 1,001 of them, where there are more). */
export function usualPeriod(times) {
  const stride = Math.max(1, Math.floor(times.length / 1001)), steps = [];
  for (let at = stride; at < times.length; at += stride) steps.push(times[at] - times[at - 1]);
  return steps.length ? steps.sort((a, b) => a - b)[steps.length >> 1] : 0;
}

/** Numbers of a series (see serve/readings.py): mode, n, k, first, times [n], and either values or low and high [n k]. */
function readSeries(buffer) {
  const [mode, n, k, first] = new Uint32Array(buffer, 0, 4);
  const times = new Float64Array(buffer, 16, n), values = new Float64Array(buffer, 16 + 8 * n, n * k);
  const high = mode === 1 ? new Float64Array(buffer, 16 + 8 * n * (1 + k), n * k) : values;
  return { exact: mode === 0, n, k, first, times, low: values, high };
}

async function decode(kind, answer) {
  if (kind === 'image') {
    const bitmap = await createImageBitmap(await answer.blob());
    return { bitmap, bytes: bitmap.width * bitmap.height * 4, free: () => bitmap.close() };
  }
  const buffer = await answer.arrayBuffer(), [a, b] = new Uint32Array(buffer, 0, 2), bytes = buffer.byteLength, free = () => {};
  if (kind === 'points') return { n: a, k: b, xyz: new Float32Array(buffer, 8), bytes, free };
  const [near, far] = new Float32Array(buffer, 8, 2);
  return { height: a, width: b, near, far, half: new Uint16Array(buffer, 16), bytes, free };
}

/** One open episode: its sensors by their place in the recording's list. */
export class Episode {
  constructor(facts, sensors, changed) {
    Object.assign(this, facts);  // number, seconds, task, start_ns, language
    this.changed = changed;
    this.closed = false;
    this.sensors = sensors.map((sensor, place) => ({ ...sensor, place, ...(facts.sensors[sensor.name] ?? { count: 0, fault: '', absent: true }) }));
    this.readings = new Map();
    this.bytes = 0;
    this.busy = 0;
    this.series = new Map();
    this.fetched = 0;
  }

  static async open(number, sensors, changed) {
    const episode = new Episode(await (await ask(`/episode/${number}`)).json(), sensors, changed);
    await Promise.all(episode.sensors.map(async (sensor) => {
      sensor.times = new Float64Array(0);
      if (sensor.count && !sensor.fault) sensor.times = new Float64Array(await (await ask(`/times/${number}/${sensor.place}`)).arrayBuffer());
      sensor.period = usualPeriod(sensor.times) || (sensor.rate_hz ? 1 / sensor.rate_hz : 0);
    }));
    return episode;
  }

  close() {
    this.closed = true;
    for (const held of this.readings.values()) held.free?.();
    this.readings.clear();
  }

  /** A decoded reading, {error}, or undefined while it is not here. */
  reading(place, index) {
    const key = place * 2 ** 32 + index, held = this.readings.get(key);
    if (!held || held.pending) return undefined;
    this.readings.delete(key);  // the latest used come last
    this.readings.set(key, held);
    return held;
  }

  /** Fetches of the wanted [place, index, across] what is not here, the first first; forgets what was not used for longest. */
  want(wanted) {
    for (const [place, index, across] of wanted) {
      if (this.busy >= AT_ONCE || this.closed) return;
      if (!this.readings.has(place * 2 ** 32 + index)) this.#fetch(place, index, across);
    }
  }

  async #fetch(place, index, across) {
    const key = place * 2 ** 32 + index;
    this.busy++;
    this.readings.set(key, { pending: true });
    let held;
    try {
      held = await decode(this.sensors[place].kind, await ask(`/reading/${this.number}/${place}/${index}?across=${across}`));
    } catch (error) {
      held = { error: error.message, bytes: 0 };
    }
    this.busy--;
    this.fetched++;
    if (this.closed) return held.free?.();
    this.readings.delete(key);
    this.readings.set(key, held);
    this.bytes += held.bytes;
    for (const [old, value] of this.readings) {
      if (this.bytes <= KEPT_BYTES) break;
      if (value.pending || old === key) continue;
      this.bytes -= value.bytes;
      value.free?.();
      this.readings.delete(old);
    }
    this.changed();
  }

  /** A series between two times in `buckets` buckets; undefined until it has arrived. */
  curve(place, from, to, buckets, pick = false) {
    const key = `${place} ${from} ${to} ${buckets} ${pick}`;
    if (!this.series.has(key)) {
      this.series.set(key, undefined);
      if (this.series.size > 400) this.series.delete(this.series.keys().next().value);
      ask(`/series/${this.number}/${place}?from=${from}&to=${to}&buckets=${buckets}${pick ? '&pick=1' : ''}`)
        .then(async (answer) => readSeries(await answer.arrayBuffer()), (error) => ({ error: error.message }))
        .then((found) => { if (!this.closed) { this.series.set(key, found); this.changed(place); } });
    }
    return this.series.get(key);
  }

  /** The exact numbers of one reading of a vector; undefined until they have come. */
  numbers(place, index) {
    const times = this.sensors[place].times, block = index >> 10, last = Math.min(times.length, (block + 1) << 10) - 1;
    const found = this.curve(place, times[block << 10], times[last], 1024);
    const row = found?.exact ? index - found.first : -1;
    return row >= 0 && row < found.n ? found.low.subarray(row * found.k, (row + 1) * found.k) : undefined;
  }
}
