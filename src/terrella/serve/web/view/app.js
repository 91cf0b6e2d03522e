// The page of a recording: opens episodes, plays them with all sensors in step, and marks the bad ones.

import { linkBack } from '../place/reach.js';
import * as library from './library.js';
import { Tiles } from './tiles.js';
import { Tracks, clock } from './tracks.js';

const $ = (id) => document.getElementById(id), view = $('view');
const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4, 8], ROW = 52;
let about = null, bad = new Set(), episode = null, opening = -1;
let time = 0, playing = false, speed = 1, last = 0, dirty = true, held = 0, stepper = null, painted = 0;
let filtered = [], which = 'all';

const write = (id, text) => { if ($(id).textContent !== text) $(id).textContent = text; };
const count = (number, word) => `${number.toLocaleString('en')} ${word}${number === 1 ? '' : 's'}`;
const tiles = new Tiles($('tiles'), () => { dirty = true; });
const tracks = new Tracks($('tracks'), { seek, step: chooseStepper });

let toastTimer = 0;
function toast(text) {
  write('toast', text);
  $('toast').classList.add('show');
  clearTimeout(toastTimer);
  toastTimer = setTimeout(() => $('toast').classList.remove('show'), 2200 + 45 * text.length);
}

// -- opening ----------------------------------------------------------------------------------------------------------

async function begin() {
  try {
    about = await library.about();
  } catch (error) {
    view.dataset.state = 'refused';
    return write('banner', error.message);
  }
  bad = new Set(about.bad);
  document.title = `${about.name} · Terrella`;
  write('name', about.name);
  const seconds = about.episodes.reduce((sum, each) => sum + each.seconds, 0);
  write('what', [about.robot, seconds < 60 ? `${seconds.toFixed(1)} seconds` : `${(seconds / 60).toFixed(seconds < 600 ? 1 : 0)} minutes`, count(about.sensors.length, 'sensor')].filter(Boolean).join(' · '));
  $('export').hidden = !about.can_export || !about.export_to;
  drawFacts();
  drawMarks();
  const asked = new URLSearchParams(location.hash.slice(1)), number = Number(asked.get('episode') ?? 0);
  if (!about.episodes.length) { view.dataset.state = 'empty'; return write('banner', `${about.name} has no episodes.`); }
  await open(Number.isInteger(number) && about.episodes[number] ? number : 0, Number(asked.get('time')) || 0);
}

async function open(number, at = 0) {
  if (!about?.episodes[number] || number === opening) return;
  opening = number;
  drawList(true);
  let next;
  try {
    next = await library.Episode.open(number, about.sensors, (place) => { dirty = true; if (place !== undefined) tracks.arrived(place); });
  } catch (error) {
    if (opening !== number) return;
    opening = -1;
    view.dataset.state = 'broken';
    episode?.close();
    episode = null;
    $('tiles').replaceChildren();
    $('lanes').replaceChildren();
    write('task', '');
    return write('banner', error.message);
  }
  if (opening !== number) return next.close();
  episode?.close();
  episode = next;
  opening = -1;
  view.dataset.state = 'open';
  write('banner', '');
  write('task', episode.task || `Episode ${number}`);
  write('when', episode.start_ns ? new Date(Number(BigInt(episode.start_ns) / 1000000n)).toISOString().replace('T', ' ').replace(/\.\d+Z/, ' UTC') : '');
  write('end', `/ ${clock(episode.seconds, 3)}`);
  $('timeline').ariaValueMax = episode.seconds;
  const has = (sensor) => sensor.times.length > 0;
  const chosen = episode.sensors.find((sensor) => sensor.name === stepper && has(sensor));
  stepper = (chosen ?? episode.sensors.find((sensor) => sensor.kind === 'image' && has(sensor)) ?? episode.sensors.find(has))?.name ?? null;
  tiles.open(episode);
  tracks.open(episode, stepping()?.place);
  time = Math.min(Math.max(0, at), episode.seconds);
  tracks.reveal(time);
  last = 0;
  dirty = true;
  drawMarks();
  remember();
}

const stepping = () => episode?.sensors.find((sensor) => sensor.name === stepper);

function chooseStepper(place) {
  stepper = episode.sensors[place].name;
  tracks.setStepper(place);
  dirty = true;
  toast(`The arrow keys step by ${episode.sensors[place].label}.`);
}

function remember() {
  history.replaceState(null, '', `${location.pathname}${location.search}#episode=${episode.number}${time ? `&time=${time.toFixed(3)}` : ''}`);
}

// -- time -------------------------------------------------------------------------------------------------------------

function tick(now) {
  requestAnimationFrame(tick);
  if (!episode) return;
  if (playing) {
    const next = Math.min(episode.seconds, time + (last ? Math.min(0.1, (now - last) / 1000) * speed : 0));
    if (tiles.ready(next)) {  // all cameras go on together, or wait together
      if (next !== time) { time = next; dirty = true; }
      held = 0;
      if (time >= episode.seconds) pause();
    } else held++;
    if (time > tracks.to) tracks.reveal(time);
  }
  last = now;
  episode.want(tiles.needs(time, speed, playing));
  if (!dirty) return;
  dirty = false;
  draw();
}

function draw() {
  tiles.draw(time);
  tracks.place(time);
  tracks.write(time);
  write('now', clock(time, 3));
  $('timeline').ariaValueNow = time.toFixed(3);
  const sensor = stepping(), at = sensor ? library.indexAt(sensor.times, time) : -1;
  write('frame', sensor ? `${sensor.label} ${Math.max(0, at + 1).toLocaleString('en')} of ${sensor.count.toLocaleString('en')}` : '');
  write('spoken', episode.language.filter(([from]) => from <= time + 1e-9).at(-1)?.[1] ?? '');
  if (tiles.ready(time)) painted++;
}

function play() {
  if (!episode) return;
  if (time >= episode.seconds) seek(0);
  playing = true;
  last = 0;
  drawPlay();
}

function pause() {
  playing = false;
  dirty = true;
  drawPlay();
  remember();
}

const toggle = () => (playing ? pause() : play());

function drawPlay() {
  $('play').querySelector('use').setAttribute('href', playing ? '#i-pause' : '#i-play');
  $('play').ariaLabel = playing ? 'Pause' : 'Play';
}

function seek(to) {
  if (!episode) return;
  time = Math.min(episode.seconds, Math.max(0, to));
  tracks.reveal(time);
  dirty = true;
}

/** Steps by readings of the stepping sensor, forward or back, exactly to their times. */
function step(by) {
  if (!episode) return;
  if (playing) pause();
  const times = stepping()?.times;
  if (!times) return;
  const at = library.indexAt(times, time), on = by < 0 && at >= 0 && times[at] < time - 1e-6 ? at + by + 1 : at + by;
  seek(times[Math.min(times.length - 1, Math.max(0, on))]);
  remember();
}

function setSpeed(value) {
  speed = value;
  for (const button of $('speeds').children) button.setAttribute('aria-pressed', Number(button.value) === speed);
}

// -- the list ---------------------------------------------------------------------------------------------------------

function applyFilter() {
  const words = $('filter').value.trim().toLowerCase().split(/\s+/).filter(Boolean);
  filtered = about.episodes.map((_, number) => number).filter((number) => {
    if (which !== 'all' && bad.has(number) !== (which === 'bad')) return false;
    const task = about.episodes[number].task.toLowerCase();
    return words.every((word) => task.includes(word) || String(number) === word);
  });
  drawList();
}

/** Only the rows in sight are made: a recording may have ten thousand. */
function drawList(reveal = false) {
  const list = $('list'), current = opening >= 0 ? opening : episode?.number;
  $('rows').style.height = `${filtered.length * ROW + 8}px`;
  if (reveal) {
    const y = filtered.indexOf(current) * ROW;
    if (y >= 0 && (y < list.scrollTop || y + ROW > list.scrollTop + list.clientHeight)) list.scrollTop = y - list.clientHeight / 2 + ROW;
  }
  const first = Math.max(0, Math.floor(list.scrollTop / ROW) - 4), final = Math.min(filtered.length, first + Math.ceil(list.clientHeight / ROW) + 9);
  $('rows').replaceChildren(...filtered.slice(first, final).map((number, at) => {
    const row = Object.assign(document.createElement('div'), { className: bad.has(number) ? 'episode bad' : 'episode', role: 'option' });
    const facts = about.episodes[number], [name, task, length, dot] = ['b', 'span', 'small', 'i'].map((tag) => document.createElement(tag));
    name.textContent = number;
    task.textContent = task.title = facts.task || 'no task';
    length.textContent = `${facts.seconds < 60 ? `${facts.seconds.toFixed(1)} s` : clock(facts.seconds, 0)} · ${count(facts.rows, 'frame')}`;
    if (bad.has(number)) dot.title = 'marked bad';
    row.setAttribute('aria-selected', number === current);
    row.dataset.number = number;
    row.style.top = `${(first + at) * ROW}px`;
    row.append(name, task, length, dot);
    row.onclick = () => open(number);
    return row;
  }));
  if (!filtered.length) $('rows').append(Object.assign(document.createElement('p'), { className: 'nobody', textContent: 'No episode matches.' }));
}

function neighbour(by) {
  if (!about) return;
  const current = opening >= 0 ? opening : episode?.number ?? -1;
  const order = by > 0 ? filtered : filtered.toReversed();
  const next = order.find((number) => (by > 0 ? number > current : number < current));
  if (next === undefined) return toast(by > 0 ? 'This is the last episode of the list.' : 'This is the first episode of the list.');
  open(next);
}

// -- marks and export -------------------------------------------------------------------------------------------------

function drawMarks() {
  const good = about.episodes.length - bad.size, now = !!episode && bad.has(episode.number);
  write('count', about.episodes.length.toLocaleString('en'));
  write('count-word', about.episodes.length === 1 ? 'episode' : 'episodes');
  write('bad-count', bad.size.toLocaleString('en'));
  $('mark').setAttribute('aria-pressed', now);
  write('mark-words', now ? 'Marked bad' : 'Mark bad');
  write('export-words', `${count(good, 'good episode')} of ${about.episodes.length} will be written as a new recording to ${about.export_to}. This one stays as it is.`);
  $('export-go').disabled = good === 0;
  applyFilter();
}

async function markBad() {
  if (!episode) return;
  const number = episode.number, now = !bad.has(number);
  try {
    bad = new Set(await library.mark(number, now));
  } catch (error) {
    return toast(error.message);
  }
  drawMarks();
}

async function exportGood() {
  $('export-go').disabled = true;
  try {
    let status = await library.startExport();
    $('export-bar').hidden = false;
    while (status.state === 'running') {
      $('export-bar').firstElementChild.style.transform = `scaleX(${status.of ? status.done / status.of : 0})`;
      await new Promise((done) => setTimeout(done, 250));
      status = await library.exportStatus();
    }
    $('export-bar').firstElementChild.style.transform = `scaleX(${status.state === 'done' ? 1 : 0})`;
    if (status.state === 'failed') throw new Error(status.text);
    toast(status.text);
    write('export-words', `${status.text}.`);
  } catch (error) {
    $('export-bar').hidden = true;
    write('export-words', error.message);
    toast(error.message);
  }
  $('export-go').disabled = false;
}

function drawFacts() {
  const facts = $('facts'), add = (tag, text, parent = facts) => parent.appendChild(Object.assign(document.createElement(tag), { textContent: text }));
  facts.replaceChildren();
  add('h2', about.name);
  const list = add('dl', '');
  for (const sensor of about.sensors) {
    add('dt', sensor.label, list);
    const shape = sensor.kind === 'points' ? sensor.names.join(', ') : sensor.shape.join(' × ');
    add('dd', [sensor.kind, shape, sensor.rate_hz && `${+sensor.rate_hz.toFixed(3)} Hz`, sensor.frame].filter(Boolean).join(' · '), list);
  }
  for (const note of about.notes) add('p', note);
  add('h2', 'Keys');
  const keys = Object.assign(add('div', ''), { className: 'keys' });
  for (const [key, meaning] of [['space', 'play, pause'], ['← →', 'one frame; with shift one second'], ['home end', 'first and last'], ['[ ]', 'episode before, after'], ['B', 'mark bad, or good again'], ['< >', 'slower, faster'], ['+ − 0', 'zoom in time; the wheel on the ruler does too'], ['/', 'filter the episodes'], ['double click', 'one picture alone']]) {
    add('kbd', key, keys);
    add('span', meaning, keys);
  }
}

// -- wiring -----------------------------------------------------------------------------------------------------------

const zoomAt = (factor) => episode && tracks.zoom(factor, Math.min(tracks.to, Math.max(tracks.from, time)));
const faster = (by) => setSpeed(SPEEDS[Math.min(SPEEDS.length - 1, Math.max(0, SPEEDS.indexOf(speed) + by))]);
const KEYS = {
  ' ': toggle, ArrowLeft: (e) => (e.shiftKey ? seek(time - 1) : step(-1)), ArrowRight: (e) => (e.shiftKey ? seek(time + 1) : step(1)),
  Home: () => seek(0), End: () => episode && seek(episode.seconds), '[': () => neighbour(-1), ']': () => neighbour(1), b: markBad, B: markBad,
  '<': () => faster(-1), '>': () => faster(1), '+': () => zoomAt(0.5), '=': () => zoomAt(0.5), '-': () => zoomAt(2), 0: () => episode && tracks.fit(),
  '/': () => $('filter').focus(), '?': () => toggleCard('about'),
  Escape: () => { for (const name of ['about', 'export']) if (!$(`${name}-card`).hidden) toggleCard(name); if (tiles.alone) { tiles.alone = null; tiles.layout(); dirty = true; } },
};

function toggleCard(name) {
  const card = $(`${name}-card`);
  card.hidden = !card.hidden;
  $(name).setAttribute('aria-expanded', !card.hidden);
  const other = name === 'about' ? 'export' : 'about';
  if (!card.hidden && !$(`${other}-card`).hidden) toggleCard(other);
}

addEventListener('keydown', (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.target.tagName === 'INPUT') {
    if (event.key === 'Escape') event.target.blur();
    if (event.key === 'Enter' && filtered.length) { open(filtered[0]); event.target.blur(); }
    return;
  }
  if (event.target.closest?.('button') && (event.key === 'Enter' || event.key === ' ')) return;
  if (!KEYS[event.key] || (event.repeat && ['b', 'B', ' ', '?'].includes(event.key))) return;
  event.preventDefault();
  KEYS[event.key](event);
});
addEventListener('click', (event) => { if (event.detail) event.target.closest('button')?.blur(); });  // the space bar is for playing

$('play').onclick = toggle;
$('back').onclick = () => step(-1);
$('forth').onclick = () => step(1);
$('mark').onclick = markBad;
$('fit').onclick = () => episode && tracks.fit();
$('about').onclick = $('about-card').querySelector('.close').onclick = () => toggleCard('about');
$('export').onclick = $('export-card').querySelector('.close').onclick = () => toggleCard('export');
$('export-go').onclick = exportGood;
$('filter').oninput = applyFilter;
$('list').onscroll = () => drawList();
for (const button of document.querySelectorAll('[data-which]')) {
  button.onclick = () => {
    which = button.dataset.which;
    for (const other of document.querySelectorAll('[data-which]')) other.setAttribute('aria-pressed', other === button);
    applyFilter();
  };
}
$('speeds').append(...SPEEDS.map((value) => {
  const button = Object.assign(document.createElement('button'), { value, textContent: `${value}×` });
  button.onclick = () => setSpeed(value);
  return button;
}));
setSpeed(1);
$('split').onpointerdown = (event) => $('split').setPointerCapture(event.pointerId);
$('split').onpointermove = (event) => {
  if (!$('split').hasPointerCapture(event.pointerId)) return;
  const foot = view.getBoundingClientRect().bottom - event.clientY - ($('tracks').getBoundingClientRect().top - $('split').getBoundingClientRect().top);
  $('tracks').style.setProperty('--tracks', `${Math.round(Math.min(innerHeight * 0.7, Math.max(60, foot)))}px`);
};
new ResizeObserver(() => about && drawList()).observe($('list'));

/** Read-only figures for tests. */
window.viewer = Object.freeze({
  get state() { return view.dataset.state; },
  get time() { return time; },
  get playing() { return playing; },
  get episode() { return episode?.number ?? -1; },
  get painted() { return painted; },
  get ready() { return !!episode && tiles.ready(time); },
  get fetched() { return episode?.fetched ?? 0; },
  get bad() { return [...bad]; },
  get range() { return [tracks.from, tracks.to]; },
  get shown() { return Object.fromEntries(tiles.shown.filter((tile) => tile.sensor).map((tile) => [tile.sensor.label, tile.painted])); },
  get listed() { return [...filtered]; },
});

linkBack();
begin().then(() => requestAnimationFrame(tick));
