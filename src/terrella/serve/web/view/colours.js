// The page's colours: lines of a plot, and ramps for depth and height.

export const MUTE = '#8d9097', FAINT = '#5b5f67', LINE = '#24272d', AURORA = '#7fe3c4', AMBER = '#f0c274', EMBER = '#ff6b5e';
const LINES = ['#7fe3c4', '#f0c274', '#7fb2f0', '#f08fa6', '#b69cf0', '#b9dd7a', '#f2a274', '#74d3e8'];

export const lineColour = (place) => LINES[place % LINES.length];

function ramp(stops) {
  const rgb = stops.map((stop) => [1, 3, 5].map((at) => parseInt(stop.slice(at, at + 2), 16)));
  const table = new Uint32Array(256);
  for (let at = 0; at < 256; at++) {
    const place = (at / 255) * (rgb.length - 1), low = Math.min(rgb.length - 2, Math.floor(place)), part = place - low;
    const [r, g, b] = [0, 1, 2].map((c) => Math.round(rgb[low][c] + (rgb[low + 1][c] - rgb[low][c]) * part));
    table[at] = (255 << 24) | (b << 16) | (g << 8) | r;
  }
  return table;
}

// little-endian RGBA, from near to far and from low to high
export const NEAR_FAR = ramp(['#fff4dc', '#f7cf86', '#ea8f6b', '#b95a86', '#704c9c', '#36427f', '#15203f']);
export const LOW_HIGH = ramp(['#29407a', '#2d6f9a', '#45a9ab', '#7fe3c4', '#f3efd9']);
export const NOTHING = (255 << 24) | (15 << 16) | (12 << 8) | 11;  // where nothing was hit

/** Paints a ramp into a canvas from the top down. */
export function paintRamp(canvas, table) {
  canvas.width = 1;
  canvas.height = 256;
  const image = new ImageData(1, 256);
  new Uint32Array(image.data.buffer).set(table);
  canvas.getContext('2d').putImageData(image, 0, 0);
}
