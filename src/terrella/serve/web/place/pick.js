// The point under the pointer: along its ray, where the transmittance falls to one half.

import { axesOf } from './draw.js';

/** The place and the number of the Gaussian that a ray from `eye` along `way` meets; null where it meets nothing. */
export function pick(scene, eye, way) {
  const { means, scales, opacities } = scene, hits = [];
  for (let k = 0; k < scene.length; k += 1) {
    const x = means[3 * k] - eye[0], y = means[3 * k + 1] - eye[1], z = means[3 * k + 2] - eye[2];
    const along = x * way[0] + y * way[1] + z * way[2], wide = 3.5 * Math.max(scales[3 * k], scales[3 * k + 1], scales[3 * k + 2]);
    if (along < -wide || x * x + y * y + z * z - along * along > wide * wide) continue;
    const { alpha, t } = met(scene, k, [x, y, z], way);
    if (alpha > 0.02 && t > 0.05) hits.push({ t, alpha, k });
  }
  hits.sort((one, other) => one.t - other.t);
  let left = 1;
  for (const { t, alpha, k } of hits) {
    left *= 1 - Math.min(alpha, 0.99);
    if (left < 0.5) return { place: eye.map((part, a) => part + t * way[a]), number: k };
  }
  return null;
}

/** How much of a ray a Gaussian at `off` takes at most, and where. */
function met(scene, k, off, way) {
  const m = axesOf(scene, k);
  let ab = 0, aa = 0, bb = 0;
  for (let axis = 0; axis < 3; axis += 1) {
    const s2 = Math.max(scene.scales[3 * k + axis], 1e-5) ** 2, i = 3 * axis;
    const a = (m[i] * way[0] + m[i + 1] * way[1] + m[i + 2] * way[2]) / s2, b = (m[i] * off[0] + m[i + 1] * off[1] + m[i + 2] * off[2]) / s2;
    ab += a * b;
    aa += a * a;
    bb += b * b;
  }
  const t = ab / aa, q = Math.max(bb - t * ab, 0) / 2;
  return { alpha: scene.opacities[k] * Math.exp(-q), t };
}
