// The page of a place: opens it, walks in it, edits it.

import { Boxes } from './boxes.js';
import { axes, matrices } from './camera.js';
import { Compare } from './compare.js';
import { Drawing, NEAR } from './draw.js';
import { Editor } from './editor.js';
import { Film } from './film.js';
import { follow } from './follow.js';
import { Hands } from './hands.js';
import { offerHeadset } from './headset.js';
import { MiniMap } from './minimap.js';
import { keepEye, keptEye, Light } from './light.js';
import { Orbit } from './orbit.js';
import { spotAt } from './put.js';
import { linkBack, reach } from './reach.js';
import { decoded, inflate, joined, Reader, unpackScene } from './scene.js';
import { Solid } from './solid.js';
import { drawsInSoftware, Soft } from './soft.js';
import { Sorter } from './sort.js';
import { Story } from './story.js';
import { Walker } from './walk.js';

const $ = (id) => document.getElementById(id);
const TALL = 0.62, WIDEST = 1.35, SLOW_MS = 40, FAST_MS = 20, COARSEST = 0.25, LEAST = 0.04, FEWEST = 12000, LEAD = 0.06;
const seen = { painted: 0, times: [], share: 1, stands: 1, dirty: true, last: 0, running: false, toasted: 0, sorted: '', solidOf: null };

const world = JSON.parse($('world').textContent), canvas = $('view');
$('name').textContent = world.name;
await new Promise((done) => { setTimeout(done); });  // so that the banner is shown

const ready = await open().catch((error) => {
  $('place').dataset.state = 'failed';
  $('banner').textContent = error.message.charAt(0).toUpperCase() + error.message.slice(1);
});

async function open() {
  if (!window.Worker) throw new Error('this browser runs no web workers; open the place in a newer one.');
  const soft = drawsInSoftware() && location.hash !== '#webgl', { source, solid } = await unpacked(world, decoded($('data').textContent));
  $('data').remove();
  const story = new Story(source, [], source.length === world.count ? await others() : undefined);
  try { story.begin(source, world.edits); } catch (error) { if (source.length === world.count) throw error; }  // the rest comes
  const drawingOn = (element) => (soft ? new Soft(element, () => seen.arrived?.(), () => toast('this browser could not draw the place: close other tabs and reload the page.')) : new Drawing(element));
  return { drawing: drawingOn(canvas), drawingOn, source, story, solid };
}

/** What comes first of a place: Gaussians that are spread over all, and what is solid. */
async function unpacked(about, packed) {
  const reader = new Reader(await inflate(packed)), solid = world.boxes.length ? new Boxes(world.boxes) : Solid.unpack(reader, about.solid);
  return { source: unpackScene(reader, { ...world, count: about.first }), solid };
}

/** The scenes that edits merge, as soon as the page is there. */
async function others() {
  const found = new Map();
  while (!$('end')) await new Promise((done) => { setTimeout(done, 20); });
  const packed = $('merged').textContent.split(' ');
  $('merged').remove();
  for (const [at, about] of world.merged.entries()) found.set(about.sha256, unpackScene(new Reader(await inflate(decoded(packed[at]))), about));
  return found;
}

/** All Gaussians, as soon as the rest of the page is there. */
async function whole(source) {
  while (!$('end') || !seen.painted) await new Promise((done) => { setTimeout(done, 50); });
  const rest = unpackScene(new Reader(await inflate(decoded($('rest').textContent))), { count: world.count - source.length });
  $('rest').remove();
  return Object.assign(joined(source, rest), { before: world.count });
}

if (ready) run(ready);

function run({ drawing, drawingOn, source, story, solid: first }) {
  let solid = first, made = '';
  const closed = new Map();  // what stops walkers after edits, by their lines
  const walker = new Walker(world), orbit = new Orbit(walker), map = new MiniMap($('minimap').querySelector('canvas'), source);
  const sorter = new Sorter(({ order, coarse, all, view }) => { drawing.order(order, coarse); Object.assign(seen, { visible: all, looked: view.looks }); redraw(); });
  const hands = new Hands(canvas, $('stick'), {
    moved: walks, tool: (name, event) => editor.open && editor.selecting.handle(name, event), look,
    key: (event) => editor.open && editor.gizmo.key(event), still: () => orbit.on, zoom: (factor) => { if (orbit.on) { orbit.zoom(factor); redraw(); } },
  });
  const compare = new Compare(redraw, drawingOn);
  const editor = new Editor(story, drawing, {
    changed: take, marked: (mask) => { drawing.mark(story.scene, mask); redraw(); }, redraw, eye: () => walker.eye, lens, say: toast, keep, look, orbits: () => orbit.on,
    solid: () => solid, body: world.body, put: world.things, command: world.command, key: world.key,
  });

  const film = new Film($('film'), {
    eye: () => walker.eye, stand: ([x, y, z, heading, pitch]) => { if (orbit.on) turnAround(); walker.set([x, y, z], heading, pitch, true); redraw(); },
    picture, unsaved: () => story.unsaved, expose: (stops) => { drawing.stops = stops; redraw(); }, redraw: () => redraw(), say: toast,
    name: world.name.replace(/[^\w]+/g, '-').replace(/^-|-$/g, '').slice(0, 60) || 'place', kept: `terrella-film ${[world.name, world.key || world.count, ...world.starts[0]].join()}`, address: world.files, drawn: world.drawn, command: world.command, key: world.key,
  });

  new Light($('light'), {
    light: world.light, address: world.relight, command: world.command, key: world.key, unsaved: () => story.unsaved, say: toast,
    leave: () => { const { place, heading, pitch } = walker.eye; keepEye(JSON.stringify([place, heading, pitch, walker.flying])); },
  });

  /** The view as a picture, without lines: a blob of PNG. */
  async function picture() {
    paint(false);
    while (drawing.busy) {
      await new Promise((done) => { setTimeout(done, 20); });
      paint(false);  // a frame in between was drawn with lines
    }
    const { width, height } = canvas, page = Object.assign(document.createElement('canvas'), { width, height }), context = page.getContext('2d');
    context.fillStyle = '#0b0c0f';
    context.fillRect(0, 0, width, height);
    context.drawImage(canvas, 0, 0);
    redraw();
    return new Promise((done) => { page.toBlob(done, 'image/png'); });
  }

  /** A scene is drawn, and what is solid is read off it. */
  function take(scene) {
    drawing.set(scene, seen.stands);
    if (!drawing.soft) sorter.set(scene);
    solid = scene === source ? first : scene.boxes ? new Boxes(scene.boxes) : closed.get(story.lines) ?? (world.closed ? first.edited(source, scene, world.samples) : Solid.of(scene, world.samples));
    if (scene !== source && story.edits.some(closes)) close(story.lines);
    Object.assign(map, { layer: null }, map.source === source ? {} : { source, own: null });
    seen.sorted = '';
    $('what').textContent = `${seen.stands > 1 ? `${scene.length.toLocaleString('en')} of ${world.count.toLocaleString('en')}` : scene.length.toLocaleString('en')} Gaussians${made}`;
    const drawn = scene.opacities.reduce((sum, one) => sum + (one > 0), 0), known = scene.seen.reduce((sum, one, k) => sum + (one && scene.opacities[k] > 0), 0) / Math.max(drawn, 1);
    $('share-seen').textContent = `${Math.round(100 * known)}%`;
    $('share-invented').textContent = `${Math.round(100 * (1 - known))}%`;
    redraw();
  }

  /** Whether a merge changes what is inside: one of a place, not of a thing, where either of both is closed. */
  function closes({ do: does, place, sha256 }) {
    return does === 'merge' && !place.startsWith('things/') && (world.closed || story.others.get(sha256)?.closed) && !story.scene.boxes;
  }

  /** What stops walkers after merges, as Python computes it: of the server, or what came with the page. */
  async function close(lines) {
    if (closed.has(lines)) return;
    const given = !world.collider && lines === story.saved ? world.after : null;
    if (!given && !world.collider) return;
    closed.set(lines, solid);  // till it comes
    try {
      const { boxes, solid: about, data } = given ?? await (await reach(world.collider + location.search, world.command, { method: 'POST', body: JSON.stringify({ lines, key: world.key }) })).json();
      closed.set(lines, boxes.length ? new Boxes(boxes) : Solid.unpack(new Reader(await inflate(decoded(data))), about));
      if (lines === story.lines) { solid = closed.get(lines); redraw(); }
    } catch (error) {
      closed.delete(lines);
      toast(error.message);
    }
  }

  /** A newer state of a place that is being made. */
  async function newer(about, packed) {
    ({ source, solid: first } = await unpacked(about, packed));
    made = ` · step ${about.step.toLocaleString('en')} of ${about.steps.toLocaleString('en')} · ${about.db.toFixed(1)} dB`;
    $('making').firstElementChild.style.width = `${(100 * about.step) / about.steps}%`;
    story.begin(source, []);
    seen.stands = 1;
    take(source);
  }

  /** Draws beside the place another one, or itself as it was before its edits; or no more. */
  async function contrast() {
    if (compare.open) { compare.show(null); return; }
    if (seen.stands > 1) { toast('Wait until the whole place is loaded.'); return; }
    if (!world.beside && !story.edits.length) { toast('This place has no edits to compare. `terrella space view PLACE --beside OTHER` compares it with another place or file.'); return; }
    const other = (await beside()) ?? source;
    seen.sorted = '';
    compare.show(other, world.beside?.name ?? 'before its edits');
  }

  /** What it is compared with, or is merged with, where the page has one. */
  async function beside() {
    if (world.beside) seen.beside ??= unpackScene(new Reader(await inflate(decoded($('beside').textContent))), world.beside);
    return seen.beside;
  }

  function lens() {
    const aspect = innerWidth / innerHeight, wide = Math.min(WIDEST, TALL * aspect);
    return { wide, tall: wide / aspect };
  }

  /** Who walks leaves the orbit. */
  function walks() {
    if (orbit.on && hands.wish.some(Boolean)) turnAround();
    wake();
  }

  function look(dx, dy) {
    const across = (2 * lens().wide * dx) / innerWidth, up = (2 * lens().tall * dy) / innerHeight;
    if (orbit.on) orbit.turn(-2 * across, -2 * up); else walker.look(across, up);
    if (orbit.on) redraw(); else wake();
  }

  /** Begins to turn around what is selected, or what is ahead; or ends it. */
  function turnAround() {
    const target = orbit.on ? null : editor.gizmo.bounds ? editor.gizmo.middle : spotAt(story.scene, solid, world.body, walker.eye.place, axes(walker.eye).ahead).at;
    orbit.around(target);
    flip('orbit', orbit.on);
  }

  function redraw() { seen.dirty = true; wake(); }

  function wake() {
    if (seen.running) return;
    seen.running = true;
    seen.last = performance.now();
    requestAnimationFrame(frame);
  }

  function frame(time) {
    const passed = Math.min(Math.max(time - seen.last, 0), 200), moves = walker.pass(solid, hands.wish, passed / 1000);
    Object.assign(seen, { last: time, before: seen.last, dirty: seen.dirty || (seen.moves && !moves), moves });  // at rest it is drawn once more
    if (moves && !drawing.soft) adapt(time - seen.before); else if (seen.share < 1 && !seen.dirty && !sorter.busy) Object.assign(seen, { share: Math.min(1, 3 * seen.share), dirty: true });
    sort();
    if ((moves || seen.dirty) && drawing.ready && compare.ready) paint();  // till it is ordered, what is on the screen stays
    if (moves || seen.dirty || sorter.busy || compare.busy || seen.share < 1) requestAnimationFrame(frame); else { seen.running = false; figures(); }
  }

  /** Coarser while it moves where the browser draws slowly, and sharper and sharper when it stands still. */
  function adapt(passed) {
    seen.mean = 0.8 * (seen.mean ?? FAST_MS) + 0.2 * Math.min(passed, 200);
    const share = seen.mean > SLOW_MS ? Math.max(LEAST, seen.share * (passed > 3 * SLOW_MS ? Math.max(0.1, SLOW_MS / passed) : 0.85)) : seen.mean < FAST_MS ? Math.min(1, seen.share * 1.1) : seen.share;
    if (share !== seen.share) Object.assign(seen, { share, mean: (SLOW_MS + FAST_MS) / 2 });
  }

  /** Has the Gaussians ordered for where the eye is, if it is elsewhere than for the last order. */
  function sort() {
    const eye = walker.eye, most = seen.share < 1 ? Math.max(FEWEST, seen.share * (seen.visible ?? 1e9)) : Infinity;
    const key = [...eye.place, eye.heading, eye.pitch, innerWidth, innerHeight, seen.share].map((part) => part.toFixed(3)).join();
    if (key === seen.sorted) return;
    Object.assign(seen, { sorted: key, dirty: true });
    if (drawing.soft) return;
    sorter.ask({ ...sight(), most });
    compare.ask({ ...sight(), most });
  }

  function sight() { return { eye: walker.eye.place, ...axes(walker.eye), ...lens(), near: NEAR, looks: [walker.eye.heading, walker.eye.pitch] }; }

  /** The eye, turned no farther than the last order reaches to the sides: beyond it nothing is drawn yet. */
  function shownEye() {
    const { place, heading, pitch } = walker.eye, near = (at, middle) => Math.max(middle - LEAD, Math.min(middle + LEAD, at));
    if (!seen.looked) return walker.eye;
    const shown = [near(heading, seen.looked[0]), near(pitch, seen.looked[1])];
    return orbit.on ? orbit.eye(...shown) : { place, heading: shown[0], pitch: shown[1] };
  }

  function paint(lines = true) {
    const sharp = (devicePixelRatio || 1) * Math.max(COARSEST, seen.share), width = Math.round(innerWidth * sharp), height = Math.round(innerHeight * sharp);
    if (!drawing.soft && (canvas.width !== width || canvas.height !== height)) Object.assign(canvas, { width, height });
    seen.dirty = false;
    drawing.clear();
    const eye = shownEye(), view = { ...matrices(eye, lens()), eye, lens: lens(), moves: seen.moves }, part = [0, 0, width, height];
    drawing.paint(view, part, lines ? [...editor.wires, ...film.wires] : []);
    compare.paint(drawing, view, part, !seen.moves && seen.share === 1 && !sorter.busy && !compare.busy && !drawing.busy && !editor.wires.length);
    editor.gizmo.place();
    if (!$('minimap').hidden) map.draw(story.scene, walker.eye, lens().wide, world.body.eye_m);
    seen.painted += 1;
    if (!drawing.soft) shown();
  }

  /** A picture came onto the screen. */
  function shown() {
    $('place').dataset.state = 'open';
    seen.times.push(performance.now());
    if (seen.times.length > 240) seen.times.splice(0, 120);
  }

  seen.arrived = () => {
    shown();
    if (compare.open) redraw();
  };

  function figures() {
    const since = performance.now() - 1500, times = seen.times.filter((time) => time > since);
    $('fps').textContent = times.length > 4 ? Math.round(((times.length - 1) * 1000) / (times.at(-1) - times[0])) : '–';
    $('where').textContent = walker.eye.place.map((part) => part.toFixed(1)).join(' ');
    $('fly').setAttribute('aria-pressed', walker.flying);
  }

  const home = () => { if (orbit.on) turnAround(); walker.start(0); redraw(); };
  const fly = () => { walker.flying = !walker.flying; wake(); figures(); };
  const flip = (id, shown) => { $(id).setAttribute('aria-pressed', shown); redraw(); };
  const tint = () => { drawing.tint = 1 - drawing.tint; $('legend').hidden = !drawing.tint; flip('tint', !!drawing.tint); };
  const showMap = () => { $('minimap').hidden = !$('minimap').hidden; flip('map-open', !$('minimap').hidden); };
  const full = () => (document.fullscreenElement ? document.exitFullscreen() : $('place').requestFullscreen?.());
  const filming = () => { if (editor.open && !film.open) editor.toggle(); film.toggle(); flip('filming', film.open); };
  const editing = () => { if (film.open) filming(); editor.toggle(); };
  const putHere = () => { if (world.things) { if (!editor.open) editing(); editor.take('put'); editor.put.choose(); $('put-words').focus(); redraw(); } };
  const does = { home, fly, orbit: turnAround, edit: editing, filming, tint, compared: contrast, 'map-open': showMap, full };
  Object.entries(does).forEach(([id, act]) => { $(id).onclick = act; });
  const shortcuts = { KeyH: home, KeyF: fly, KeyO: turnAround, KeyN: putHere, KeyE: () => $('edit').hidden || editing(), KeyK: () => $('filming').hidden || film.add(), KeyX: () => $('filming').hidden || filming(), KeyT: () => $('tint').hidden || tint(), KeyB: () => $('compared').hidden || contrast(), KeyM: showMap, Escape: () => editor.choose(null), Delete: () => editor.open && editor.act({ do: 'delete' }) };
  addEventListener('keydown', (event) => {
    if (event.target.closest?.('input:not([type=range]), textarea')) return;
    if (event.code === 'KeyZ' && (event.ctrlKey || event.metaKey)) { event.preventDefault(); $(event.shiftKey ? 'redo' : 'undo').click(); }
    else if (!event.repeat && !event.ctrlKey && !event.metaKey && !event.altKey && shortcuts[event.code]) { event.preventDefault(); shortcuts[event.code](); }
  });
  canvas.addEventListener('wheel', (event) => {
    event.preventDefault();
    if (orbit.on) orbit.zoom(Math.exp(-event.deltaY / 900));
    else if (!(editor.open && editor.selecting.wheel(editor.chosen, event.deltaY < 0 ? 1.1 : 1 / 1.1))) walker.look(-event.deltaX / 600, -event.deltaY / 1200);
    redraw();
  }, { passive: false });
  addEventListener('resize', () => { map.layer = null; redraw(); });
  addEventListener('beforeunload', (event) => { if (story.unsaved) event.preventDefault(); });
  setInterval(figures, 400);
  const merges = world.beside?.merge;
  $('merging').hidden = !merges;
  $('merge').title = merges ? `Adds all of ${world.beside.name}, turned by ° about its origin, then moved by x y z metres` : '';
  $('merge').onclick = async () => {
    const [x, y, z, degrees] = [...$('merging').querySelectorAll('input')].map((input) => Number(input.value));
    if (![x, y, z, degrees].every(Number.isFinite)) { toast('A merge takes metres and degrees, such as 1.25.'); return; }
    story.others.set(merges.sha256, await beside());
    editor.change(() => story.add({ ...merges, by: [x, y, z], degrees }));
  };
  if (!drawing.soft) offerHeadset($('xr'), { drawing, walker, hands, sorter, solid: () => solid, redraw });

  seen.stands = world.count / source.length;
  const left = world.relight && JSON.parse(keptEye());  // before another light was baked
  if (left) { walker.set(...left); filming(); }
  take(story.scene);
  greet();
  linkBack();
  if (world.note && !world.edits.length) toast(`${world.note}.`);
  if (seen.stands > 1 && !world.watch) {  // who watches is given the newest whole
    $('edit').hidden = true;
    whole(source).then(async (all) => {
      source = all;
      story.others = await others();
      story.begin(source, world.edits);
      seen.stands = 1;
      $('edit').hidden = false;
      take(story.scene);
    }).catch((error) => toast(error.message));
  }
  if (world.watch) {
    $('making').hidden = false;
    $('edit').hidden = $('compared').hidden = $('filming').hidden = true;
    follow(world.watch, { newer, over: () => { $('making').hidden = true; toast(`The fit is done, or was stopped.${world.command ? ` If stopped, \`${world.command}\` continues it.` : ''}`); } });
  }

  // the state of the page, for scripts
  window.terrella = {
    story, editor, film, map, drawing, walker, orbit, sorter, compare, lens, sight, get solid() { return solid; }, get painted() { return seen.painted; },
    get idle() { return !seen.running && !seen.dirty && drawing.ready && !drawing.busy && compare.ready && !compare.busy && seen.stands === 1; }, get eye() { return walker.eye; },
    stand(place, heading, pitch = 0) { walker.set(place, heading, pitch, true); redraw(); },
    async pixels() {
      paint();
      while (drawing.busy) await new Promise((done) => { setTimeout(done, 20); });
      if (drawing.soft) return { width: canvas.width, height: canvas.height, data: drawing.read() };
      const { gl } = drawing, { width, height } = canvas, data = new Uint8Array(4 * width * height);
      gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, data);
      return { width, height, data };
    },
  };
}

/** Keeps edits: at the server that showed this page, or as a file. */
async function keep(lines, saved) {
  if (world.save) {
    await reach(world.save + location.search, world.command, { method: 'POST', body: JSON.stringify({ saved, lines, key: world.key }) });
    toast('Saved with the place.');
    return;
  }
  const anchor = Object.assign(document.createElement('a'), { href: URL.createObjectURL(new Blob([lines])), download: 'world.edits.jsonl' });
  anchor.click();
  setTimeout(() => URL.revokeObjectURL(anchor.href), 10000);
  toast('Saved world.edits.jsonl: `terrella space edit PLACE --replay world.edits.jsonl` applies it to the place.');
}

function greet() {
  const make = (tag, textContent) => Object.assign(document.createElement(tag), { textContent });
  const part = (caps, word) => {
    const span = make('span', '');
    span.append(...caps.map((cap) => make('kbd', cap)), make('em', word));
    return span;
  };
  const touch = matchMedia('(pointer: coarse)').matches;
  $('hint').replaceChildren(...(touch ? ['Left thumb walks, right thumb looks'] : [part([...'WASD'], 'walk'), part([], 'drag to look'), part(['Space'], 'up'), part(['C'], 'down')]));
  $('hint').classList.add('show');
  setTimeout(() => $('hint').classList.remove('show'), 8000);
}

function toast(text) {
  $('toast').textContent = text.charAt(0).toUpperCase() + text.slice(1);
  $('toast').classList.add('show');
  clearTimeout(seen.toasted);
  seen.toasted = setTimeout(() => $('toast').classList.remove('show'), Math.max(6000, 90 * text.length));
}
