// The camera: its axes, its matrices, and rays through pixels. World: metres, z up; angles in radians, heading 0 looks along x.

import { NEAR } from './draw.js';

/** ahead, right and up of an eye. */
export function axes({ heading, pitch }) {
  const c = Math.cos(heading), s = Math.sin(heading), cp = Math.cos(pitch), sp = Math.sin(pitch);
  return { ahead: [c * cp, s * cp, sp], right: [s, -c, 0], up: [-c * sp, -s * sp, cp] };
}

/** Matrices of an eye {place, heading, pitch} with a lens: half the picture's width and height at a distance of 1. */
export function matrices(eye, { wide, tall }) {
  const { ahead, right, up } = axes(eye), along = (way) => -(way[0] * eye.place[0] + way[1] * eye.place[1] + way[2] * eye.place[2]);
  const view = [0, 1, 2].flatMap((a) => [right[a], up[a], -ahead[a], 0]).concat([along(right), along(up), -along(ahead), 1]);
  const far = 1000, projection = [1 / wide, 0, 0, 0, 0, 1 / tall, 0, 0, 0, 0, -(far + NEAR) / (far - NEAR), -1, 0, 0, (-2 * far * NEAR) / (far - NEAR), 0];
  return { view, projection };
}

/** The direction through a place in the picture, u and v from -1 (left, below) to 1. */
export function ray(eye, { wide, tall }, u, v) {
  const { ahead, right, up } = axes(eye), way = [0, 1, 2].map((a) => ahead[a] + u * wide * right[a] + v * tall * up[a]), long = Math.hypot(...way);
  return way.map((part) => part / long);
}

/** Where a place is in the picture: u, v and how far ahead. */
export function project(eye, { wide, tall }, place) {
  const { ahead, right, up } = axes(eye), off = place.map((part, a) => part - eye.place[a]), dot = (way) => way[0] * off[0] + way[1] * off[1] + way[2] * off[2];
  const depth = dot(ahead);
  return { u: dot(right) / depth / wide, v: dot(up) / depth / tall, depth };
}
