// A learned world on a page of its own: keys, buttons under the picture, the clock, and how fast the network draws.

import { Network } from './network.js';
import { FlatWorld } from './world.js';
import { actionOf, encode, labelOf } from './action.js';

const $ = (id) => document.getElementById(id);
const held = [];  // codes of the keys that are down, oldest first
let about, world, state, paused = false, drawingSteps, spent = 0, since = 0;

/** The bytes of a script element that holds gzip in base64. */
async function unpacked(id) {
  const text = atob($(id).textContent), bytes = Uint8Array.from(text, (letter) => letter.charCodeAt(0));
  $(id).remove();
  return new Uint8Array(await new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream('gzip'))).arrayBuffer());
}

/** Standard normal numbers (Box & Muller 1958). */
function normal(count) {
  const numbers = new Float32Array(count);
  for (let i = 0; i < count; i += 2) {
    const radius = Math.sqrt(-2 * Math.log(1 - Math.random())), angle = 2 * Math.PI * Math.random();
    numbers[i] = radius * Math.cos(angle);
    if (i + 1 < count) numbers[i + 1] = radius * Math.sin(angle);
  }
  return numbers;
}

function show() {
  const picture = $('picture').getContext('2d'), pixels = picture.createImageData(world.width, world.height), frame = state.frames[0];
  for (let p = 0; p < world.pixels; p++) pixels.data.set([frame[3 * p], frame[3 * p + 1], frame[3 * p + 2], 255], 4 * p);
  picture.putImageData(pixels, 0, 0);
}

/** As many drawing steps as the world's own pace leaves time for, of those that it was trained with. */
function adapt(room) {
  if (++since < 12) return;
  const more = drawingSteps < about.network.steps && spent * (drawingSteps + 1) / drawingSteps < 0.8 * room;
  if (!more && (spent <= room || drawingSteps === 1)) return;
  drawingSteps += more ? 1 : -1;
  since = spent = 0;
}

function step() {
  const began = performance.now();
  const { controls } = about.world, action = encode(controls, actionOf(controls, about.rest, about.keys, held));
  state = world.step(state, action, normal(3 * world.pixels), drawingSteps);
  show();
  const took = performance.now() - began;
  spent = spent ? 0.9 * spent + 0.1 * took : took;
  const pace = 1000 / Math.max(spent, 1000 * about.dt_s), steps = drawingSteps === 1 ? '1 drawing step' : `${drawingSteps} drawing steps`;
  $('pace').textContent = `${pace.toFixed(pace < 10 ? 1 : 0)} frames a second, ${steps} each, ${spent.toFixed(0)} ms`;
  adapt(1000 * about.dt_s);
  return took;
}

function restart() {
  state = world.start(Math.floor(Math.random() * about.world.starts.length));
  show();
}

async function loop() {
  for (;;) {
    const took = paused || document.hidden ? 0 : step();
    await new Promise((next) => setTimeout(next, Math.max(4, 1000 * about.dt_s - took)));
  }
}

function press(code, down) {
  const at = held.indexOf(code);
  if (down && at < 0) held.push(code);
  if (!down && at >= 0) held.splice(at, 1);
  document.querySelectorAll('#keys button').forEach((button) => button.classList.toggle('down', button.dataset.codes.split(' ').some((one) => held.includes(one))));
}

function pause(stop) {
  paused = stop;
  document.body.classList.toggle('paused', paused);
  $('pause').textContent = paused ? 'Go on' : 'Pause';
}

/** A button for each action that has a key; it is held as a key is. */
function drawButtons() {
  const actions = new Map();
  for (const [code, row] of Object.entries(about.keys)) if (!code.includes('+')) actions.set(String(row), [...(actions.get(String(row)) ?? []), code]);
  for (const [row, codes] of actions) {
    const button = Object.assign(document.createElement('button'), { type: 'button' });
    button.dataset.codes = codes.join(' ');
    button.append(...codes.map((code) => Object.assign(document.createElement('kbd'), { textContent: labelOf(code) })), about.names[codes[0]] ?? '');
    button.addEventListener('pointerdown', (event) => { button.setPointerCapture(event.pointerId); press(codes[0], true); });
    for (const kind of ['pointerup', 'pointercancel', 'lostpointercapture']) button.addEventListener(kind, () => press(codes[0], false));
    $('keys').append(button);
  }
}

async function begin() {
  about = JSON.parse($('about').textContent);
  drawingSteps = about.network.steps;
  const [kernels, weights, bytes] = await Promise.all(['kernels', 'weights', 'bytes'].map(unpacked));
  const { instance } = await WebAssembly.instantiate(kernels);
  world = new FlatWorld(new Network(instance.exports, about.network, new Uint16Array(weights.buffer)), about.world, bytes);
  Object.assign($('picture'), { width: world.width, height: world.height });
  $('picture').style.aspectRatio = `${world.width} / ${world.height}`;
  drawButtons();
  restart();
  document.body.dataset.state = 'playing';
  window.terrella = { world, press, action: () => actionOf(about.world.controls, about.rest, about.keys, held), get state() { return state; } };
  addEventListener('keydown', (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.code === 'KeyR' && !about.keys.KeyR) return restart();
    if (event.code === 'KeyP' && !about.keys.KeyP) return pause(!paused);
    if (Object.keys(about.keys).some((codes) => codes.split('+').includes(event.code))) event.preventDefault();
    press(event.code, true);
  });
  addEventListener('keyup', (event) => press(event.code, false));
  addEventListener('blur', () => [...held].forEach((code) => press(code, false)));
  $('restart').addEventListener('click', restart);
  $('pause').addEventListener('click', () => pause(!paused));
  await loop();
}

begin().catch((error) => {
  document.body.dataset.state = 'failed';
  $('pace').textContent = `It stopped (${error.message}). It needs WebAssembly with SIMD, as browsers since 2023 have.`;
});
