// What closes the hole that a thing leaves, as in space/beneath.py: computed in double precision, by means alone.

const THICK = 0.15, NEAR = 0.06, FLAT = 0.03, CELL = 0.15, STRIP = 0.3, COVERED = 0.6, SIDES = 3, LEAST = 0.01, MOST = 0.1, MOST_NEW = 10000;

/** Among the Gaussians of a scene that `mask` leaves: where new ones are to be, and the number of the one to copy for each. */
export function beneath({ means, objects, length }, mask) {
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity], places = [], sources = [];
  for (let k = 0; k < length; k += 1) {
    if (!mask[k]) continue;
    for (let a = 0; a < 3; a += 1) { low[a] = Math.min(low[a], means[3 * k + a]); high[a] = Math.max(high[a], means[3 * k + a]); }
  }
  for (let axis = 0; axis < 3; axis += 1) {
    const others = [0, 1, 2].filter((k) => k !== axis), pair = (values) => others.map((k) => values[k]);
    for (const end of [low[axis], high[axis]]) {
      if (!(high[axis] - low[axis] >= THICK)) continue;
      let rows = [];
      for (let k = 0; k < length; k += 1) {
        const apart = (a) => Math.max(low[a] - means[3 * k + a], means[3 * k + a] - high[a]);
        if (!mask[k] && objects[k] >= 0 && Math.abs(means[3 * k + axis] - end) + STRIP - NEAR <= STRIP && others.every((a) => apart(a) <= STRIP)) rows.push(k);
      }
      if (!rows.length) continue;
      const plane = Float64Array.from(rows, (k) => means[3 * k + axis]).sort()[rows.length >> 1];
      rows = rows.filter((k) => Math.abs(means[3 * k + axis] - plane) <= FLAT);
      for (const [x, y, from] of continued(rows.map((k) => others.map((a) => means[3 * k + a])), pair(low), pair(high))) {
        const place = [plane, plane, plane];
        [place[others[0]], place[others[1]]] = [x, y];
        places.push(place);
        sources.push(rows[from]);
      }
    }
  }
  return { places, sources };
}

/** [x, y, number of the point to copy] of points that continue a surface across a rectangle. */
function continued(points, low, high) {
  const size = [0, 1].map((k) => high[k] - low[k]), { sides, area, many } = around(points, low, high), found = [];
  if (sides.filter(Boolean).length < SIDES) return found;
  let spacing = Math.min(Math.max(Math.sqrt(area / many), LEAST), MOST);
  const counts = () => size.map((wide) => Math.max(1, Math.ceil(wide / spacing))), [a, b] = counts();
  spacing *= Math.sqrt(Math.max((a * b) / MOST_NEW, 1));
  const [across, along] = counts();
  for (let i = 0; i < across; i += 1) for (let j = 0; j < along; j += 1) {
    const x = low[0] + (size[0] * (i + 0.5)) / across, y = low[1] + (size[1] * (j + 0.5)) / along;
    if (!(nearest(points, x, y)[0] > spacing * spacing)) continue;
    const deep = [x - low[0], high[0] - x, y - low[1], high[1] - y].map((far, at) => (sides[at] ? far : Infinity));
    const side = deep.indexOf(Math.min(...deep)), into = deep[side] % STRIP, mirrored = [x, y];
    mirrored[side >> 1] = side % 2 ? high[side >> 1] + into : low[side >> 1] - into;
    found.push([x, y, nearest(points, ...mirrored)[1]]);
  }
  return found;
}

/** Which sides of a rectangle are covered; the area of all cells around it with points, and how many points lie there. */
function around(points, low, high) {
  const even = (value) => (value % 1 === 0.5 ? 2 * Math.round(value / 2) : Math.round(value));  // as torch rounds
  const cells = [0, 1].map((k) => Math.max(1, even((high[k] - low[k]) / CELL)));
  const inside = (value, k) => value >= low[k] && value <= high[k];
  const cell = (value, k) => (value < low[k] ? Math.floor((value - low[k]) / CELL) : value > high[k] ? cells[k] + Math.floor((value - high[k]) / CELL) : Math.min(cells[k] - 1, Math.floor(((value - low[k]) / Math.max(high[k] - low[k], 1e-9)) * cells[k])));
  const sides = [];
  let area = 0, many = 0;
  for (const k of [0, 1]) for (const beyond of [(value) => value < low[k], (value) => value > high[k]]) {
    const here = points.filter((point) => beyond(point[k]) && inside(point[1 - k], 1 - k)), some = new Set(here.map((point) => `${cell(point[0], 0)} ${cell(point[1], 1)}`));
    sides.push(some.size >= COVERED * 2 * cells[1 - k]);
    area += (some.size * CELL * (high[1 - k] - low[1 - k])) / cells[1 - k];
    many += here.length;
  }
  return { sides, area, many };
}

/** The squared distance to the nearest point, and its number. */
function nearest(points, x, y) {
  let least = Infinity, number = -1;
  for (let k = 0; k < points.length; k += 1) {
    const dx = x - points[k][0], dy = y - points[k][1], far = dx * dx + dy * dy;
    if (far < least) { least = far; number = k; }
  }
  return [least, number];
}
