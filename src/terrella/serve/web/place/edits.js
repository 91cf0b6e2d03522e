// Edits, as in space/edits.py: positions are computed in double precision and stored in single.

import { beneath } from './beneath.js';
import { joined } from './scene.js';

const MOST_OBJECTS = 65535, REVEALED = 0.99, MOVING = ['move', 'turn', 'scale', 'delete'];
const single = (numbers) => [numbers].flat().map(Math.fround);

/** Which Gaussians {kind: numbers} selects: 1 or 0 for each, and their `count`. */
export function select(scene, chosen) {
  const [kind, given] = Object.entries(chosen)[0], n = single(given), { means, objects, length } = scene;
  const mask = new Uint8Array(length);
  let test;
  if (kind === 'box') {
    const low = [0, 1, 2].map((a) => Math.min(n[a], n[a + 3])), high = [0, 1, 2].map((a) => Math.max(n[a], n[a + 3]));
    test = (x, y, z) => x >= low[0] && x <= high[0] && y >= low[1] && y <= high[1] && z >= low[2] && z <= high[2];
  } else if (kind === 'sphere' || kind === 'brush') {
    test = (x, y, z) => {
      for (let d = 0; d < n.length; d += 4) if ((x - n[d]) ** 2 + (y - n[d + 1]) ** 2 + (z - n[d + 2]) ** 2 <= n[d + 3] * n[d + 3]) return true;
      return false;
    };
  } else if (kind === 'plane') test = (x, y, z) => x * n[0] + y * n[1] + z * n[2] > n[3];
  else if (kind === 'object') test = (x, y, z, k) => objects[k] === n[0] && n[0] > 0;
  else test = () => true;
  mask.count = 0;
  for (let k = 0; k < length; k += 1) if (test(means[3 * k], means[3 * k + 1], means[3 * k + 2], k)) { mask[k] = 1; mask.count += 1; }
  return mask;
}

/** The ends of what is selected along each axis. */
export function endsOf(scene, mask) {
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  for (let k = 0; k < scene.length; k += 1) {
    if (!mask[k]) continue;
    for (let a = 0; a < 3; a += 1) { low[a] = Math.min(low[a], scene.means[3 * k + a]); high[a] = Math.max(high[a], scene.means[3 * k + a]); }
  }
  return { low, high };
}

/** The middle of what is selected: half way between its ends along each axis. */
export function middleOf(scene, mask) {
  const { low, high } = endsOf(scene, mask);
  return low.map((value, a) => (value + high[a]) / 2);
}

/** The scene after an edit; an Error where nothing is selected. What was changed counts as not seen. others: a Map of what merges bring. */
export function edited(scene, edit, others) {
  if (edit.do === 'merge') return merged(scene, others.get(edit.sha256), single(edit.by), single(edit.degrees)[0]);
  const mask = select(scene, edit.select), { by, degrees, factor, colour } = edit;
  if (!mask.count) throw new Error('nothing is selected there; choose another place.');
  let closed = (after) => after;
  if (MOVING.includes(edit.do)) {
    scene = revealed(scene, mask);
    if (!('all' in edit.select || 'plane' in edit.select)) closed = closing(scene, mask);
  }
  if (edit.do === 'delete') return closed(scene.at(numbers(mask, 0)));
  if (edit.do === 'duplicate') {
    const many = scene.length, both = scene.at([...numbers(mask, -1), ...numbers(mask, 1)]);
    const fresh = highest(scene.objects) + 1, [dx, dy, dz] = single(by);
    both.before = scene.before;
    for (let k = many; k < both.length; k += 1) {
      both.seen[k] = 0;
      both.objects[k] = fresh;
      shift(both.means, k, dx, dy, dz);
    }
    return both;
  }
  const after = scene.copy(), middle = middleOf(scene, mask);
  const change = { move: () => moved(after, single(by)), turn: () => turned(after, single(degrees)[0], middle, middle), scale: () => scaled(after, single(factor)[0], middle), recolour: () => recoloured(after, single(colour)) }[edit.do]();
  for (let k = 0; k < after.length; k += 1) if (mask[k]) { change(k); after.seen[k] = 0; }
  return closed(after);
}

/** A function that adds to a scene what closes the hole that the selected leave in the surfaces beside them. */
function closing(scene, mask) {
  const { places, sources } = beneath(scene, mask), part = scene.at(sources);
  places.forEach((place, k) => part.means.set(place, 3 * k));
  part.seen.fill(0);
  part.objects.fill(0);
  return (after) => (places.length ? joined(after, part) : after);
}

/** The scene with the surfaces beneath the selected objects opaque, as parts of no object. */
function revealed(scene, mask) {
  const touched = new Set(scene.objects.filter((number, k) => mask[k] && number > 0));
  if (!scene.objects.some((number) => touched.has(-number))) return scene;
  const after = scene.copy();
  for (let k = 0; k < after.length; k += 1) if (touched.has(-after.objects[k])) { after.opacities[k] = REVEALED; after.objects[k] = 0; }
  return after;
}

/** The scene and all of another one: turned about the vertical through its origin, then moved; its objects are numbered on. */
function merged(scene, other, by, degrees) {
  if (!other) throw new Error('this page does not hold the place that is merged; `terrella space edit PLACE --merge OTHER` merges it.');
  const part = other.copy(), turn = turned(part, degrees, [0, 0, 0], by), raised = highest(scene.objects);
  if (raised + highest(other.objects) > MOST_OBJECTS) throw new Error('a page shows no more than 65,535 objects.');
  for (let k = 0; k < part.length; k += 1) {
    turn(k);
    part.objects[k] += raised * Math.sign(part.objects[k]);
  }
  const names = [...Array.from({ length: raised }, (_, k) => scene.names[k]), ...other.names], known = scene.boxes && other.boxes && degrees % 90 === 0;
  return Object.assign(joined(scene, part), { names, boxes: known ? [...scene.boxes, ...placed(other.boxes, by, degrees / 90)] : null });
}

/** Boxes turned by quarter turns, then moved. */
export function placed(boxes, [dx, dy, dz], quarters) {
  const left = ([x0, y0, z0, x1, y1, z1]) => [-y1, x0, z0, -y0, x1, z1];
  for (let turn = 0; turn < ((quarters % 4) + 4) % 4; turn += 1) boxes = boxes.map(left);
  return boxes.map(([x0, y0, z0, x1, y1, z1]) => [x0 + dx, y0 + dy, z0 + dz, x1 + dx, y1 + dy, z1 + dz]);
}

const highest = (objects) => objects.reduce((most, number) => Math.max(most, number), 0);

/** Numbers of those whose mask is `value`; of all where it is -1. */
function numbers(mask, value) {
  const found = [];
  for (let k = 0; k < mask.length; k += 1) if (value < 0 || mask[k] === value) found.push(k);
  return found;
}

function shift(means, k, dx, dy, dz) {
  means[3 * k] += dx;
  means[3 * k + 1] += dy;
  means[3 * k + 2] += dz;
}

const moved = (scene, [dx, dy, dz]) => (k) => shift(scene.means, k, dx, dy, dz);

/** Turned about the vertical through a place, which comes to lie at `to`. */
function turned({ means, quats }, degrees, [mx, my, mz], to) {
  const angle = degrees * (Math.PI / 180), c = Math.cos(angle), s = Math.sin(angle), ch = Math.cos(angle / 2), sh = Math.sin(angle / 2);
  return (k) => {
    const x = means[3 * k] - mx, y = means[3 * k + 1] - my, [w, qx, qy, qz] = quats.subarray(4 * k, 4 * k + 4);
    means[3 * k] = c * x - s * y + to[0];
    means[3 * k + 1] = s * x + c * y + to[1];
    means[3 * k + 2] += to[2] - mz;
    quats.set([ch * w - sh * qz, ch * qx - sh * qy, ch * qy + sh * qx, ch * qz + sh * w], 4 * k);
  };
}

const scaled = ({ means, scales }, factor, middle) => (k) => {
  for (let a = 0; a < 3; a += 1) {
    means[3 * k + a] = (means[3 * k + a] - middle[a]) * factor + middle[a];
    scales[3 * k + a] *= factor;
  }
};

const recoloured = ({ colours }, colour) => (k) => colours.set(colour, 3 * k);

/** An edit in words; `names` are those of the objects. */
export function describe(edit, names = []) {
  if (edit.do === 'merge' && edit.place.startsWith('things/')) return `put ${edit.place.slice(7).replace(/-\w+$/, '')} at ${edit.by.join(' ')} m`;
  if (edit.do === 'merge') return `merge ${edit.place.split('/').at(-1)} at ${edit.by.join(' ')} m${edit.degrees ? `, turned by ${edit.degrees}°` : ''}`;
  const kind = Object.keys(edit.select)[0], what = kind === 'all' ? 'everything' : kind === 'object' ? (names[edit.select.object - 1] || `object ${edit.select.object}`) : `a ${kind}`;
  const more = { move: () => `by ${edit.by.join(' ')} m`, duplicate: () => `${edit.by.join(' ')} m away`, turn: () => `by ${edit.degrees}°`, scale: () => `× ${edit.factor}`, recolour: () => '', delete: () => '' }[edit.do]();
  return `${edit.do} ${what} ${more}`.trim();
}
