// The page of a world: the picture, its figures, and the buttons.

import { drawCard } from './card.js';
import { Controls } from './controls.js';
import { DriverView } from './driver.js';
import { Futures } from './futures.js';
import { Goal } from './goal.js';
import { drawKeycaps, hintsOf, keyLabel, keyMeaning, learnLayout } from './keycaps.js';
import { KeyPanel } from './keypanel.js';
import { BEYOND, DONE, FRESH, Link, REPLAY } from './link.js';
import { Past, write } from './past.js';
import { takePictures } from './picture.js';
import { linkBack, reach } from './place/reach.js';
import { Screens } from './screens.js';
import { Uncertainty } from './uncertainty.js';
import { Views } from './views.js';

const $ = (id) => document.getElementById(id);
const app = $('app'), KEPT = 8192, LIFE = /^(health|life|lives|hp|hitpoints)$/i;

const now = { step: 0, oldest: 0, newest: 0, score: 0, flags: 0, actionId: 0, vitals: [] };
const seen = { painted: 0, dropped: 0, times: [], frames: [], latencies: [], latencyCount: 0 };
let worlds = [], light = () => {}, status = {}, noRecord = '', recordIn = '', command = '', state = 'connecting';
let costs = null, budgetSaid = '';
let pending = null, controlsId = 0, autoPaused = false, recordSince = 0;

// -- the connection -------------------------------------------------------------------------------------------------

const uncertainty = new Uncertainty($('uncertainty'), $('uncertainty-fill'));
const screens = new Screens($('screens'), $('over'), $('stage'), $('glow'));
const link = new Link({ frame: onFrame, event: onEvent, state: showState });
const views = new Views(screens, (show) => link.send({ type: 'show', ...show })), past = new Past(now, (message) => link.send(message), toast);
const controls = new Controls((held, time) => {
  light(held);
  if (controls.active) {
    $('hint').classList.remove('show');
    if (status.rewound && past.rewinding === null) link.send({ type: 'branch' });
    if (status.paused && !status.rewound) link.send({ type: 'resume' });
  }
  sendControls(time);
}, $('axes'));

const go = () => { if (status.rewound) link.send({ type: 'branch' }); if (status.paused) link.send({ type: 'resume' }); $('hint').classList.remove('show'); };
const quiet = () => { controls.release(); controls.axes.rest(); };
const driver = new DriverView({
  send: (message) => link.send(message), say: toast, quiet, light: (held) => light([...held, ...controls.held]), axes: controls.axes, go,
});

const futures = new Futures((on) => views.change({ futures: on }));

const goal = new Goal({ send: (message) => link.send(message), map: views.places, say: toast, quiet, go });
const panel = new KeyPanel($('keys-panel'), { changed: () => { sendKeys(); drawKeys(); $('hint').classList.remove('show'); }, pageUse, quiet: () => controls.release() });

function sendKeys() {
  link.send({ type: 'keys', keys: worlds[0].keys, names: panel.names });
}

/** Keys that were changed on another page of this world. */
function onKeys({ type, ...keys }) {
  panel.take(Object.assign(worlds[0], keys));
  drawKeys();
}

function sendControls(time) {
  controlsId += 1;
  link.send({ type: 'controls', id: controlsId, t: time, held: controls.held, axes: controls.axes.values });
}

function onEvent(body) {
  if (body.type === 'hello') hello(body);
  if (body.type === 'status') onStatus(body);
  if (body.type === 'keys') onKeys(body);
  if (body.type === 'chart') views.onChart(body);
  if (body.type === 'agent') { driver.show(body); futures.follow(body); }
  if (body.type === 'goal') goal.show(body);
  if (body.type === 'futures') futures.show(body);
  if (body.type === 'acted') driver.acted(body);
  if (body.type === 'ended') showEnding(body);
  if (body.type === 'costs') showCosts(body);
  if (body.type === 'error') toast(body.text);
}

function hello(body) {
  const same = JSON.stringify(worlds) === JSON.stringify(body.worlds);
  ({ worlds, no_record: noRecord, command, record_in: recordIn } = body);
  driver.take(body);
  past.take(worlds[0], body.no_rewind);
  if (panel.take(worlds[0])) sendKeys();
  if (!same) build();
  views.take(worlds, { same, resumed: body.resumed });
  futures.take(body);
  goal.take(body);
  sendControls(performance.now());
  now.actionId = controlsId;  // what is sent before anything is held measures nothing
  showState('starting');
}

function onStatus(body) {
  if (body.notice && body.notice !== status.notice) toast(/^saved/.test(body.notice) && recordIn ? `${body.notice.slice(0, -1)} to ${recordIn}.` : body.notice);
  if (body.recording && !status.recording) recordSince = performance.now();
  status = body;
  if (body.waits) $('hint').classList.add('show');
  app.classList.toggle('recording', !!body.recording);
  $('record').setAttribute('aria-pressed', !!body.recording);
  if (body.seed !== undefined && document.activeElement !== $('seed')) $('seed').value = body.seed;
  const paused = body.paused || body.rewound;
  $('pause').querySelector('use').setAttribute('href', paused ? '#i-play' : '#i-pause');
  $('pause').setAttribute('aria-label', paused ? 'Play' : 'Pause');
  if (body.text) showState('failed', body.text);
  else if (body.rewound) showState('rewound');
  else if (body.paused) showState('paused');
  else if (now.newest || seen.painted) showState('playing');
}

function onFrame(frame, bitmaps) {
  if (pending) {
    seen.dropped += 1;
    pending.bitmaps.forEach((bitmap) => bitmap.close());
  } else {
    requestAnimationFrame(paint);
  }
  pending = { frame, bitmaps };
}

function paint(time) {
  const { frame, bitmaps } = pending;
  pending = null;
  screens.paint(frame.images, bitmaps);
  const live = !(frame.flags & REPLAY), at = performance.now();
  if (frame.actionId > now.actionId && live) {
    keep(seen.latencies, at - frame.clientMs);
    seen.latencyCount += 1;
  }
  const fresh = frame.flags & FRESH && frame.step > 0 && live;
  past.pass(frame, fresh);
  if (fresh) screens.flash();
  if (fresh || !live) app.classList.remove('ended');
  if (live && !fresh && worlds[0].events.some((name) => frame.vitals[worlds[0].vitals.indexOf(name)] > now.vitals[worlds[0].vitals.indexOf(name)])) screens.strike();
  Object.assign(now, { step: frame.step, oldest: frame.oldest, newest: frame.newest, score: frame.score, flags: frame.flags, vitals: frame.vitals });
  now.actionId = Math.max(now.actionId, frame.actionId);
  uncertainty.show(frame.uncertainty, frame.drifted, !!(frame.flags & FRESH) || !live, !!(frame.flags & BEYOND));
  seen.painted += 1;
  keep(seen.times, time);
  keep(seen.frames, { seq: frame.seq, step: frame.step, t: at, generationMs: frame.generationMs });
  if (!live) past.draw();
  if (state === 'starting' && !status.text) onStatus(status);
}

function keep(list, value) {
  list.push(value);
  if (list.length > KEPT) list.splice(0, KEPT / 2);
}

// -- the picture ----------------------------------------------------------------------------------------------------

function build() {
  $('name').textContent = worlds.map((world) => world.name).join('  ·  ');
  document.title = `${worlds[0].name} · Terrella`;
  const { drawn, card: facts } = worlds[worlds.length - 1];
  $('what').textContent = drawn ? `${worlds.length > 1 ? 'The dream: a' : drawn[0]}${drawn.slice(1)}` : facts.what ?? '';
  $('what').classList.toggle('drawn', !!drawn);
  screens.setWorlds(worlds);
  views.drawCameras();
  drawKeys();
  drawCard($('facts'), worlds);
  $('score-cell').hidden = !worlds[0].scored;
  document.querySelectorAll('.vital').forEach((cell) => cell.remove());
  for (const name of worlds[0].vitals) {
    const cell = Object.assign(document.createElement('div'), { className: 'vital', title: explained(name) });
    cell.append(Object.assign(document.createElement('dt'), { textContent: label(name) }));
    cell.append(Object.assign(document.createElement('dd'), { id: `vital-${name}`, textContent: '–' }));
    $('score-cell').after(cell);
  }
  uncertainty.levels = worlds[worlds.length - 1].uncertainty;
  uncertainty.measure = worlds[worlds.length - 1].card.kind === 'latent' ? 'Expected error of the latent state (100%: no better than its mean)' : 'Expected error of the picture, of full brightness';
  $('sync').hidden = worlds.length < 2;
  able($('rewind'), past.why, 'Hold to rewind (Backspace)');
  able($('record'), noRecord, 'Record to a dataset');
  able($('sync'), '', 'Set the dream to the current state of the game');
  $('keys-open').hidden = !worlds[0].actions.length;
  hint();
  screens.layout();
}

function drawKeys() {
  light = drawKeycaps($('keys'), worlds[0], (code) => { showAside(panel); if (code) panel.ask(code); });
  controls.setWorld(worlds[0]);
  drawTouch();
}

function able(button, why, title) {
  button.setAttribute('aria-disabled', !!why);
  button.title = why ? `${title}: not available, ${why}` : title;
}

/** How a number is called: events are counted. */
function label(name) {
  const counted = worlds[0].events.includes(name) && !/(n|d)$/.test(name);
  return name.replaceAll('_', ' ') + (!counted ? '' : /s$/.test(name) ? 'es' : 's');
}

/** What a number means; '' where its name says it. */
function explained(name) {
  if (!worlds[0].events.includes(name)) return LIFE.test(name) ? 'At 0 the episode ends' : '';
  const what = { hit: 'Shots of yours that hit something', fallen: 'Opponents that have fallen' };
  return `${what[name] ?? `How often “${name.replaceAll('_', ' ')}” happened`} in this episode`;
}

/** A number as it is shown: nobody has less than no health, though a blow may take more than was left. */
function figure(name, value) { return +(LIFE.test(name) ? Math.max(0, value) : value).toFixed(1); }

/** The last picture of an episode, with how it ended, until the next begins. Its numbers come with it: a slow page may never have painted that picture. */
function showEnding({ outcome, text, steps, vitals, score }) {
  const seconds = steps * worlds[0].dt_s, numbers = worlds[0].vitals.map((name, at) => [name, vitals[at]]).filter(([name, value]) => value && !LIFE.test(name));
  $('ending-text').textContent = text;
  $('ending-more').textContent = [...numbers.map(([name, value]) => `${+value.toFixed(1)} ${label(name)}`), worlds[0].scored && `score ${+score.toFixed(1)}`, `${seconds < 10 ? seconds.toFixed(1) : Math.round(seconds)} s`].filter(Boolean).join(' · ');
  app.dataset.outcome = outcome;
  app.classList.add('ended');
}

function hint() {
  const world = worlds[0], touch = app.classList.contains('touchable'), make = (tag, textContent) => Object.assign(document.createElement(tag), { textContent });
  const keys = touch ? [] : hintsOf(world).map(([codes, word]) => {
    const part = make('span', '');
    part.append(...codes.map((code) => make('kbd', keyLabel(code))), make('em', word));
    return part;
  });
  const axes = !world.axes.length ? [] : [make('span', touch || !screens.cameras.length ? 'Move a slider' : 'Move a slider, or click the picture and move the mouse')];
  $('hint').replaceChildren(...(touch && !world.axes.length ? [make('span', ['Put a thumb on a stick', ...controls.plan.extra.slice(0, 2).map((code) => `press “${keyMeaning(world, code)}”`)].join(', '))] : [...keys, ...axes]));
  $('hint').classList.toggle('show', $('hint').childElementCount > 0 && world.actions.length + world.axes.length > 0);
  setTimeout(() => $('hint').classList.toggle('show', !!status.waits), 20000);
}

const STATES = {
  connecting: ['Connecting', ''], starting: ['Starting the world', ''], playing: ['', ''], paused: ['', ''], rewound: ['', ''],
  reconnecting: ['Reconnecting', 'The world is paused.'], away: ['The server does not answer', 'Where it has stopped, this command starts it again. This page then goes on by itself.'], elsewhere: ['Open in another page', '', 'Play here'],
  refused: ['Not connected', '', 'Try again'], failed: ['The world stopped', '', 'Restart'],
};

function showState(name, text = '') {
  if (name === 'starting' && seen.painted && status.seed !== undefined && !status.text) name = status.rewound ? 'rewound' : status.paused ? 'paused' : 'playing';
  state = name;
  app.dataset.state = name;
  const [title, more, button] = STATES[name];
  $('banner').classList.toggle('show', !!title);
  if (title) [$('banner-text').textContent, $('banner-more').textContent] = [title, text || more];
  $('banner-command').hidden = name !== 'away' || !command;
  $('banner-command').textContent = command;
  $('banner-button').hidden = !button;
  $('banner-button').textContent = button ?? '';
  past.dirty = true;
}

let toastTimer = 0;
function toast(text) {
  $('toast').textContent = text.charAt(0).toUpperCase() + text.slice(1);
  $('toast').classList.add('show');
  clearTimeout(toastTimer);
  toastTimer = setTimeout(() => $('toast').classList.remove('show'), 6000);
}

// -- figures and the timeline, four times a second ------------------------------------------------------------------

function fps() {
  const since = performance.now() - 2000, times = seen.times.filter((time) => time > since);
  return times.length > 1 ? ((times.length - 1) * 1000) / (times[times.length - 1] - times[0]) : 0;
}

/** What play costs: watts of the server's process, labelled where they are estimated, and what keeping a budget takes. */
function showCosts({ watts, estimated, how, bytes, budget, kept, step_s: step }) {
  const pace = Math.min(1, worlds[0].dt_s / step), budgeted = budget ? `, of ${budget} W` : '';
  costs = { watts, estimated, bytes, kept };
  $('watts-cell').hidden = false;
  $('watts-name').textContent = estimated ? 'est. power' : 'power';
  write('watts', watts < 9.95 ? watts.toFixed(1) : Math.round(watts), 'W');
  $('watts-cell').title = `Power of the server${budgeted} (${how}). The states of this session hold ${(bytes / 2 ** 20).toFixed(1)} MiB`;
  const words = !budget || (kept && pace === 1) ? '' : kept ? `${budget} W are kept at ${Math.round(100 * pace)}% of the world's pace.` : step >= 1 ? `${budget} W cannot be kept, even at a step a second.` : '';
  if (words && words.replace(/\d+%/, '') !== budgetSaid) toast(words);
  budgetSaid = words.replace(/\d+%/, '') || budgetSaid;
}

function drawFigures() {
  const recent = seen.latencies.slice(-24).sort((a, b) => a - b);
  write('fps', state === 'playing' ? Math.round(fps()) : '–');
  if (recent.length) write('latency', Math.round(recent[recent.length >> 1]), 'ms');
  write('step', now.step.toLocaleString('en'));
  write('score', +now.score.toFixed(2));
  worlds.length && worlds[0].vitals.forEach((name, at) => write(`vital-${name}`, figure(name, now.vitals[at] ?? 0)));
  if (status.recording) {
    const s = Math.floor((performance.now() - recordSince) / 1000);
    write('rec-time', `${Math.floor(s / 60)}:${String(s % 60).padStart(2, '0')}`);
  }
  if (past.dirty) past.draw();
}

// -- commands -------------------------------------------------------------------------------------------------------

function togglePause() {
  link.send({ type: status.paused || status.rewound ? 'resume' : 'pause' });
}

function restart(seed) {
  past.ticks = [];
  link.send({ type: 'restart', seed });
}

function seedTyped() {
  const seed = Number($('seed').value);
  if (Number.isInteger(seed) && seed >= 0 && seed < 2 ** 31) return seed;
  toast(`A seed is a whole number from 0 to ${2 ** 31 - 1}.`);
  return null;
}

function restartTyped() {
  const seed = seedTyped();
  if (seed !== null) restart(seed);
}

async function clip() {
  $('clip').setAttribute('aria-busy', 'true');
  toast('Making a video of the last seconds.');
  try {
    const answer = await reach(link.clipAddress(), command);
    const name = /filename="([^"]+)"/.exec(answer.headers.get('content-disposition'))?.[1] ?? 'terrella.mp4';
    const anchor = Object.assign(document.createElement('a'), { href: URL.createObjectURL(await answer.blob()), download: name });
    anchor.click();
    setTimeout(() => URL.revokeObjectURL(anchor.href), 10000);
    toast(`Saved ${name}.`);
  } catch (error) {
    toast(`No video: ${error.message}`);
  }
  $('clip').removeAttribute('aria-busy');
}

function record() {
  if (noRecord) return toast(`Not recording: ${noRecord}`);
  link.send({ type: 'record', on: !status.recording });
}

function drawTouch() {
  const { stick, turn, extra } = controls.plan;
  const { plan } = controls.axes;
  $('stick').hidden = !Object.values(stick).some(Boolean) && !plan.lx && !plan.ly;
  $('turn').hidden = !turn && !plan.rx;
  const { axes } = controls.axes;
  $('stick').querySelector('em').textContent = axes.length ? controls.axes.movedBy('lx', 'ly') : 'move';
  $('turn').querySelector('em').textContent = axes.length ? controls.axes.movedBy('rx') : 'turn';
  $('extra').replaceChildren(...(worlds[0].axes.length ? [] : extra).map((code) => {
    const button = Object.assign(document.createElement('button'), { textContent: keyMeaning(worlds[0], code) });
    controls.bindButton(button, code);
    return button;
  }));
}

// -- wiring ---------------------------------------------------------------------------------------------------------

const escape = () => (panel.open || card.open ? showAside(null) : togglePause());
const SHORTCUTS = { KeyM: () => views.toggleMap(), KeyT: () => views.toggleTint(), KeyC: () => views.nextCamera(), KeyG: () => driver.toggle(), KeyV: () => futures.toggle(), KeyB: () => goal.keep(), KeyP: togglePause, Escape: escape, KeyR: restartTyped, Enter: () => status.rewound && link.send({ type: 'branch' }), KeyF: fullscreen };

/** What the page itself does with a key, here and now; '' where it does nothing. */
function pageUse(code) {
  const uses = {
    KeyM: !$('map-open').hidden && 'shows the map', KeyT: !$('tint').hidden && 'tints invented pixels', KeyG: driver.there && 'lets the agent drive', KeyV: futures.there && 'shows the futures that the agent considers', KeyB: goal.pictures && 'remembers the goal',
    KeyC: screens.cameras.length > 1 && 'changes the camera', KeyP: 'pauses', KeyR: 'restarts', KeyF: 'fills the screen', Enter: 'goes on from the past',
  };
  return uses[code] || '';
}

function fullscreen() {
  return document.fullscreenElement ? document.exitFullscreen() : app.requestFullscreen?.();
}

addEventListener('keydown', (event) => {
  if (event.target.tagName === 'INPUT' || event.ctrlKey || event.metaKey || event.altKey) return;
  const button = event.target.closest?.('a, button, summary') && (event.code === 'Enter' || event.code === 'Space');
  if (event.target === $('timeline') && past.key(event.code)) return event.preventDefault();
  if (controls.press(event.code, event.timeStamp)) event.preventDefault();
  else if (event.code === 'Backspace') { event.preventDefault(); if (!event.repeat) past.startRewind(); }
  else if (!event.repeat && !button && SHORTCUTS[event.code]) { event.preventDefault(); SHORTCUTS[event.code](); }
});
addEventListener('click', ({ target, detail }) => { if (detail) target.closest?.('button')?.blur(); });  // after a mouse, keys are the world's
addEventListener('keyup', (event) => {
  controls.lift(event.code, event.timeStamp);
  if (event.code === 'Backspace') past.stopRewind();
});

$('pause').onclick = togglePause;
$('restart').onclick = restartTyped;
$('dice').onclick = () => restart(null);
$('seed').onkeydown = (event) => { if (event.code === 'Enter') { restartTyped(); $('seed').blur(); } if (event.code === 'Escape') $('seed').blur(); };
$('record').onclick = record;
$('clip').onclick = clip;
$('sync').onclick = () => link.send({ type: 'sync' });
$('full').onclick = fullscreen;
$('smooth').onclick = () => $('smooth').setAttribute('aria-pressed', app.classList.toggle('smooth'));
$('branch').onclick = () => link.send({ type: 'branch' });
$('now').onclick = () => link.send({ type: 'resume' });
$('banner-command').onclick = async () => { await navigator.clipboard.writeText(command); toast('Copied.'); };
$('banner-button').onclick = () => (state === 'failed' ? restart(status.seed ?? 0) : link.connect());
const card = { get open() { return !$('card').hidden; }, toggle(open) { $('card').hidden = !open; } };
function showAside(which) {
  for (const [one, button] of [[card, $('about')], [panel, $('keys-open')]]) {
    if (one.open !== (one === which)) one.toggle(one === which);
    button.setAttribute('aria-expanded', one.open);
  }
}
for (const [one, opens, closes] of [[card, 'about', 'card-close'], [panel, 'keys-open', 'keys-close']]) {
  $(opens).onclick = () => { showAside(one.open ? null : one); $(opens).blur(); };
  $(closes).onclick = () => showAside(null);
}
learnLayout(() => { if (worlds.length) drawKeys(); });

takePictures($('app'), $('picture'), () => worlds[0]?.cameras[0].size, (bytes, asGoal) => { if (asGoal) quiet(); link.sendPicture(bytes, asGoal); }, toast, (x) => goal.dropped(x));
controls.bindPad($('stick'), 'stick');
controls.bindPad($('turn'), 'turn');
controls.axes.bindMouse($('screens'));
const coarse = matchMedia('(pointer: coarse)');
const touchable = () => { app.classList.toggle('touchable', coarse.matches); screens.layout(); };
coarse.addEventListener('change', touchable);
addEventListener('touchstart', () => { app.classList.add('touchable'); screens.layout(); }, { once: true, passive: true });
touchable();

new ResizeObserver(() => screens.layout()).observe($('stage'));
let leaving = false;  // a page that is closed or reloaded is hidden too, but its timeline goes on
addEventListener('pagehide', () => { leaving = true; });
addEventListener('pageshow', () => { leaving = false; });
document.addEventListener('visibilitychange', () => {
  if (document.hidden && !leaving && state === 'playing') { autoPaused = true; link.send({ type: 'pause' }); }
  if (!document.hidden && autoPaused) { autoPaused = false; link.send({ type: 'resume' }); }
});
setInterval(drawFigures, 250);
setInterval(() => { if (state === 'playing') screens.drawGlow(); }, 500);

/** Read-only figures for tests and benchmarks. */
window.terrella = Object.freeze({
  get connected() { return link.connected; },
  get state() { return state; },
  get fps() { return fps(); },
  get step() { return now.step; },
  get oldest() { return now.oldest; },
  get newest() { return now.newest; },
  get painted() { return seen.painted; },
  get dropped() { return seen.dropped; },
  get bytes() { return link.bytes; },
  get keys() { return Object.keys(controls.keys); },
  get held() { return [...controls.held]; },
  get recording() { return !!status.recording; },
  get seed() { return status.seed; },
  get axes() { return [...controls.axes.values]; },
  get driving() { return !!status.driving; },
  get agent() { return { name: driver.name, said: driver.said, held: [...driver.held], futures: futures.count, goal: goal.at, goalPicture: !!goal.shown, goalWords: goal.instruction }; },
  get uncertainty() { return uncertainty.value; },
  get uncertaintyLevel() { return uncertainty.level; },
  get map() { return views.figures; },
  get done() { return !!(now.flags & DONE); },
  get latencies() { return [...seen.latencies]; },
  get costs() { return costs; },
  get latencyCount() { return seen.latencyCount; },
  framesAfter: (seq) => seen.frames.filter((frame) => frame.seq > seq),
  drop: () => link.socket?.close(4999),
});

linkBack();
link.connect();
