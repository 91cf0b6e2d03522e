// A floor plan seen from above: rooms are drawn as boxes, things are put into them, and the server builds the place.

import { make, go, address } from './asking.js';

const $ = (id) => document.getElementById(id), NS = 'http://www.w3.org/2000/svg', KEPT = 'terrella-plan';
const SNAP = 0.25, LEAST = 1.5, WALL = 0.3, CORNER = 0.16, FINGER = 0.3, VIEW = { x: -1, y: -1, wide: 18, tall: 11 };
const FACINGS = ['south', 'east', 'north', 'west'], MOVES = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const state = { plan: { rooms: [], things: [] }, past: [], chosen: null, tool: 'room', drag: null };
const { rooms: kinds, things: labels } = await (await fetch(address('/start/kinds'))).json();
const snap = (value) => Math.round(value / SNAP) * SNAP, board = $('board');

const shape = (tag, fields, ...inside) => {
  const node = document.createElementNS(NS, tag);
  for (const [name, value] of Object.entries(fields)) if (name === 'text') node.textContent = value; else node.setAttribute(name, value);
  node.append(...inside);
  return node;
};
const same = (one, other) => one && other && one.list === other.list && one.at === other.at;
const about = ({ list, at }) => state.plan[list][at];

/** Where a pointer is, in metres: x east, y north. */
function place(event) {
  const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(board.getScreenCTM().inverse());
  return [at.x, -at.y];
}

/** A thing's box as it is turned: width and depth along x and y. */
function spread({ label, facing }) {
  const [wide, deep] = labels[label].size;
  return facing === 'east' || facing === 'west' ? [deep, wide] : [wide, deep];
}

/** What lies under a point: a corner of the selected room, a thing, a room, or nothing. */
function under([x, y], touch) {
  const { plan, chosen } = state, near = touch ? FINGER : CORNER + 0.06;
  if (chosen?.list === 'rooms') {
    const box = about(chosen).box, corner = [[0, 1], [2, 1], [0, 3], [2, 3]].find(([a, b]) => Math.hypot(box[a] - x, box[b] - y) < near);
    if (corner) return { ...chosen, corner };
  }
  const thing = plan.things.findLastIndex((one) => { const [w, d] = spread(one); return Math.abs(x - one.at[0]) < Math.max(w / 2, near / 2) && Math.abs(y - one.at[1]) < Math.max(d / 2, near / 2); });
  if (thing >= 0) return { list: 'things', at: thing };
  const room = plan.rooms.findLastIndex(({ box }) => x > box[0] && x < box[2] && y > box[1] && y < box[3]);
  return room >= 0 ? { list: 'rooms', at: room } : null;
}

/** The things in a room, doors and windows in its walls too. */
const within = ({ box: [a, b, c, d] }) => state.plan.things.filter(({ label, at: [x, y] }) => {
  const by = label === 'door' || label === 'window' ? WALL : 0;
  return x >= a - by && x <= c + by && y >= b - by && y <= d + by;
});

/** A room or thing as it is now, with what a room holds: a function that puts all of it `by` metres from there. */
function carry(one) {
  const parts = [one, ...(one.box ? within(one) : [])].map((part) => [part, part.box ? 'box' : 'at']).map(([part, key]) => [part, key, [...part[key]]]);
  return (by) => { for (const [part, key, was] of parts) part[key] = was.map((value, k) => (one.box ? value + by[k % 2] : Math.round((value + by[k % 2]) * 20) / 20)); };
}

const copy = () => JSON.stringify(state.plan);
function keep(before) {
  if (before === copy()) return;
  state.past.push(before);
  localStorage.setItem(KEPT, copy());
}

board.onpointerdown = (event) => {
  if (event.button) return;
  board.setPointerCapture(event.pointerId);
  const at = place(event), hit = under(at, event.pointerType === 'touch'), before = copy();
  if (state.tool === 'thing' && hit?.list !== 'things') {
    state.plan.things.push({ label: $('label').value, at: at.map((part) => Math.round(part * 20) / 20), facing: 'south' });
    state.chosen = { list: 'things', at: state.plan.things.length - 1 };
    state.drag = { does: 'move', from: at, before, carry: carry(about(state.chosen)) };
  } else if (hit) {
    state.chosen = { list: hit.list, at: hit.at };
    state.drag = { does: hit.corner ? 'corner' : 'move', corner: hit.corner, from: at, before, carry: carry(about(hit)) };
  } else {
    state.chosen = null;
    state.drag = { does: 'draw', from: at.map(snap), to: at.map(snap), before };
  }
  draw();
};

board.onpointermove = (event) => {
  const { drag, chosen } = state;
  if (!drag) return;
  const at = place(event), by = at.map((part, a) => part - drag.from[a]);
  if (drag.does === 'draw') drag.to = at.map(snap);
  else if (drag.does === 'corner') drag.corner.forEach((k, a) => { about(chosen).box[k] = snap(at[a]); });
  else drag.carry(chosen.list === 'rooms' ? by.map(snap) : by);
  draw();
};

board.onpointerup = board.onpointercancel = () => {
  const { drag } = state;
  state.drag = null;
  if (!drag) return;
  if (drag.does === 'draw') {
    const box = [0, 1].map((a) => Math.min(drag.from[a], drag.to[a])).concat([0, 1].map((a) => Math.max(drag.from[a], drag.to[a])));
    if (box[2] - box[0] >= LEAST && box[3] - box[1] >= LEAST) {
      state.plan.rooms.push({ kind: $('kind').value, box });  // not selected: its corners would take the next room's first press
    } else if (box[2] - box[0] > 0 && box[3] - box[1] > 0) help(`A room is ${LEAST} m wide or more; drag farther.`, true);
  } else if (drag.does === 'corner') {
    const [a, b, c, d] = about(state.chosen).box, [x0, x1, y0, y1] = [Math.min(a, c), Math.max(a, c), Math.min(b, d), Math.max(b, d)];
    about(state.chosen).box = [x0, y0, Math.max(x1, x0 + LEAST), Math.max(y1, y0 + LEAST)];
  }
  keep(drag.before);
  draw();
};

/** Changes the plan, so that it can be undone. */
function change(does) {
  const before = copy();
  does();
  keep(before);
  draw();
}

const actions = {
  turn: () => state.chosen?.list === 'things' && change(() => { const one = about(state.chosen); one.facing = FACINGS[(FACINGS.indexOf(one.facing) + 1) % 4]; }),
  remove: () => state.chosen && change(() => {
    const { plan, chosen } = state, gone = chosen.list === 'rooms' ? within(about(chosen)) : [];
    plan[chosen.list].splice(chosen.at, 1);
    Object.assign(plan, { things: plan.things.filter((one) => !gone.includes(one)) });  // what stood in it goes with it
    state.chosen = null;
  }),
  undo: () => { if (state.past.length) { Object.assign(state, { plan: JSON.parse(state.past.pop()), chosen: null }); localStorage.setItem(KEPT, copy()); draw(); } },
  clear: () => change(() => Object.assign(state, { plan: { rooms: [], things: [] }, chosen: null })),
};
for (const [id, act] of Object.entries(actions)) $(id).onclick = act;
board.onkeydown = (event) => {
  const by = MOVES[event.key];
  if (event.key === 'r' || event.key === 'R') actions.turn();
  else if (event.key === 'Delete' || event.key === 'Backspace') actions.remove();
  else if (event.key === 'z' && (event.ctrlKey || event.metaKey)) actions.undo();
  else if (by && state.chosen) change(() => carry(about(state.chosen))(by.map((part) => part * SNAP)));
  else return;
  event.preventDefault();
};
for (const [id, tool] of [['kind', 'room'], ['label', 'thing']]) {
  const choose = () => { state.tool = tool; draw(); };
  $(id).parentElement.onpointerdown = $(id).onfocus = choose;
  $(id).onchange = choose;
}
$('make').onsubmit = (event) => {
  event.preventDefault();
  if (!state.plan.rooms.length) { help('Draw a room first.', true); return; }
  const words = $('style').value.trim() || $('style').placeholder;
  go('plan', JSON.stringify({ ...state.plan, words, furnish: $('furnish').checked }), 'Building the place …');
};

function help(text, wrong = false) {
  $('help').textContent = text;
  $('help').classList.toggle('wrong', wrong);
}

function draw() {
  const { plan, chosen, drag, tool } = state, { x, y, wide, tall } = VIEW, nodes = [];
  for (let k = Math.ceil(x); k <= x + wide; k += 1) nodes.push(shape('path', { class: `grid${k % 5 ? '' : ' metre'}`, 'stroke-width': 0.02, d: `M${k} ${-y - tall}V${-y}` }));
  for (let k = Math.ceil(y); k <= y + tall; k += 1) nodes.push(shape('path', { class: `grid${k % 5 ? '' : ' metre'}`, 'stroke-width': 0.02, d: `M${x} ${-k}H${x + wide}` }));
  plan.rooms.forEach(({ kind, box: [a, b, c, d] }, at) => {
    const [x0, x1, y0, y1] = [Math.min(a, c), Math.max(a, c), Math.min(b, d), Math.max(b, d)], on = same(chosen, { list: 'rooms', at });
    const room = shape('g', { class: `room${on ? ' chosen' : ''}` }, shape('rect', { x: x0, y: -y1, width: x1 - x0, height: y1 - y0, rx: 0.06 }),
      shape('text', { x: x0 + 0.2, y: 0.32 - y1, text: kind }), shape('text', { class: 'size', x: x0 + 0.2, y: 0.66 - y1, text: `${(x1 - x0).toFixed(2)} × ${(y1 - y0).toFixed(2)} m` }));
    if (on) for (const [cx, cy] of [[a, b], [c, b], [a, d], [c, d]]) room.append(shape('circle', { class: 'corner', cx, cy: -cy, r: CORNER }));
    nodes.push(room);
  });
  plan.things.forEach((one, at) => {
    const [w, d] = spread(one), [cx, cy] = [one.at[0], -one.at[1]], way = { south: [0, 1], east: [1, 0], north: [0, -1], west: [-1, 0] }[one.facing];
    nodes.push(shape('g', { class: `thing${same(chosen, { list: 'things', at }) ? ' chosen' : ''}` }, shape('rect', { x: cx - w / 2, y: cy - d / 2, width: w, height: d, rx: 0.05 }),
      shape('path', { d: `M${cx} ${cy}L${cx + (way[0] * w) / 2 + 0.14 * way[0]} ${cy + (way[1] * d) / 2 + 0.14 * way[1]}` }), shape('text', { x: cx, y: cy, text: one.label })));
  });
  if (drag?.does === 'draw') {
    const [[ax, ay], [bx, by]] = [drag.from, drag.to];
    nodes.push(shape('rect', { class: 'drawing', x: Math.min(ax, bx), y: -Math.max(ay, by), width: Math.abs(ax - bx), height: Math.abs(ay - by) }));
    if (ax !== bx && ay !== by) help(`${Math.abs(ax - bx).toFixed(2)} × ${Math.abs(ay - by).toFixed(2)} m`);
  } else if (!$('help').classList.contains('wrong') || chosen) help(tool === 'thing' ? 'Press in a room to put the thing there; doors and windows go to the nearest wall. R turns, Delete removes.' : 'Drag a room on the grid. Rooms that touch are joined by a door. Press on a room to move or resize it.');
  board.replaceChildren(...nodes);
  $('kind').parentElement.classList.toggle('chosen', tool === 'room');
  $('label').parentElement.classList.toggle('chosen', tool === 'thing');
  $('turn').disabled = chosen?.list !== 'things';
  $('remove').disabled = !chosen;
  $('undo').disabled = !state.past.length;
}

/** Shows the whole plan, and some room around it. */
function fit() {
  const ends = state.plan.rooms.map(({ box }) => box), aspect = board.clientWidth / Math.max(board.clientHeight, 1);
  const low = [0, 1].map((a) => Math.min(0, ...ends.map((box) => box[a])) - 1), high = [0, 1].map((a) => Math.max(a ? 8 : 10, ...ends.map((box) => box[a + 2])) + 1);
  const wide = Math.max(high[0] - low[0], (high[1] - low[1]) * aspect), tall = wide / aspect;
  Object.assign(VIEW, { x: (low[0] + high[0] - wide) / 2, y: (low[1] + high[1] - tall) / 2, wide, tall });
  board.setAttribute('viewBox', `${VIEW.x} ${-VIEW.y - tall} ${wide} ${tall}`);
  draw();
}

$('kind').append(...Object.keys(kinds).map((kind) => make('option', { textContent: kind })));
$('label').append(...Object.keys(labels).map((label) => make('option', { textContent: label })));
$('kind').value = 'livingroom';
$('label').value = 'table';
$('back').href = address('/');
try { state.plan = JSON.parse(localStorage.getItem(KEPT)) ?? state.plan; } catch { /* a plan that cannot be read is none */ }
addEventListener('resize', fit);
fit();
window.plan = state;  // for scripts
