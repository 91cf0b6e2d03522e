// Lines around the selection: boxes and spheres.

const COLOUR = [0.5, 0.89, 0.77, 0.9];

export function wiresOf(chosen) {
  if (!chosen) return [];
  const [kind, n] = Object.entries(chosen)[0];
  if (kind === 'box') return [{ points: box(n), colour: COLOUR }];
  if (kind === 'sphere') return [{ points: sphere(n), colour: COLOUR }];
  if (kind === 'brush') return [{ points: sphere(n.slice(-4)), colour: COLOUR }];
  return [];
}

/** A ring on the floor with a tick in front: where something is to be put. */
export function marker({ at, floor, degrees }) {
  const points = [], parts = 48, turn = (degrees * Math.PI) / 180, z = floor + 0.02;
  for (const radius of [0.32, 0.06]) for (let k = 0; k < parts; k += 1) for (const end of [k, k + 1]) {
    points.push(at[0] + radius * Math.cos((2 * Math.PI * end) / parts), at[1] + radius * Math.sin((2 * Math.PI * end) / parts), z);
  }
  for (const far of [0.32, 0.5]) points.push(at[0] + far * Math.sin(turn), at[1] - far * Math.cos(turn), z);
  return [{ points: new Float32Array(points), colour: COLOUR }];
}

function box([x0, y0, z0, x1, y1, z1]) {
  const at = (k) => [k & 1 ? x1 : x0, k & 2 ? y1 : y0, k & 4 ? z1 : z0], points = [];
  for (let k = 0; k < 8; k += 1) for (const bit of [1, 2, 4]) if (!(k & bit)) points.push(...at(k), ...at(k | bit));
  return new Float32Array(points);
}

function sphere([x, y, z, radius]) {
  const points = [], parts = 48;
  for (let axis = 0; axis < 3; axis += 1) for (let k = 0; k < parts; k += 1) for (const turn of [k, k + 1]) {
    const c = radius * Math.cos((turn / parts) * 2 * Math.PI), s = radius * Math.sin((turn / parts) * 2 * Math.PI);
    points.push(...[[x, y + c, z + s], [x + c, y, z + s], [x + c, y + s, z]][axis]);
  }
  return new Float32Array(points);
}
