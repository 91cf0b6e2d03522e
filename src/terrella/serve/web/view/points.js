// A point cloud in its sensor's own frame, turned with the mouse: points with a depth buffer, coloured by their height.

import { LOW_HIGH, NOTHING, paintRamp } from './colours.js';
import { metres } from './depth.js';

const RINGS_M = [1, 2, 5, 10, 20, 50, 100];

export function makePoints(figure, canvas) {
  const orbit = { turn: -2.36, tilt: 0.62, away: 0 };  // seen from behind and the right; the sensor looks along x
  let cloud = null, span = null, reach = 0, buffer = null;
  const scale = Object.assign(document.createElement('div'), { className: 'scale', hidden: true });
  const top = document.createElement('span'), foot = document.createElement('span'), bar = document.createElement('canvas');
  paintRamp(bar, LOW_HIGH.slice().reverse());
  scale.append(top, foot, bar);
  figure.append(scale);

  function draw() {
    const ratio = Math.min(2, devicePixelRatio || 1), width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
    if (!cloud || !width || !height) return;
    if (!buffer || buffer.width !== width || buffer.height !== height) {
      Object.assign(canvas, { width, height });
      buffer = { width, height, image: new ImageData(width, height), depth: new Float32Array(width * height) };
    }
    const { image, depth } = buffer, pixels = new Uint32Array(image.data.buffer);
    pixels.fill(NOTHING);
    depth.fill(Infinity);
    const view = project(width, height), { n, k, xyz } = cloud, dot = Math.max(1, Math.round(Math.sqrt((width * height) / Math.max(n, 1)) / 14)) + (ratio > 1 ? 1 : 0);
    for (let at = 0; at < n; at++) {
      const z = xyz[at * k + 2], [px, py, far] = view(xyz[at * k], xyz[at * k + 1], z);
      if (far < 0.05) continue;
      const colour = LOW_HIGH[Math.round(255 * Math.min(1, Math.max(0, (z - span[0]) / (span[1] - span[0]))))];
      for (let y = py | 0; y <= (py | 0) + dot; y++) {
        for (let x = px | 0; x <= (px | 0) + dot; x++) {
          if (x < 0 || y < 0 || x >= width || y >= height || far >= depth[y * width + x]) continue;
          depth[y * width + x] = far;
          pixels[y * width + x] = colour;
        }
      }
    }
    const context = canvas.getContext('2d');
    context.putImageData(image, 0, 0);
    drawRings(context, view, ratio);
  }

  function project(width, height) {
    const [ct, st, cp, sp] = [Math.cos(orbit.turn), Math.sin(orbit.turn), Math.cos(orbit.tilt), Math.sin(orbit.tilt)];
    const away = reach * 2.2 * Math.exp(orbit.away), focal = 0.95 * Math.min(width, height * 1.3);
    return (x, y, z) => {
      const along = -(x * ct + y * st), beside = -x * st + y * ct;  // the viewer stands at angle `turn`, looking inwards
      const far = along * cp - z * sp + away, up = along * sp + z * cp;
      return [width / 2 + (focal * beside) / far, height / 2 - (focal * up) / far, far];
    };
  }

  function drawRings(context, view, ratio) {
    context.lineWidth = ratio;
    context.strokeStyle = '#ffffff1f';
    context.fillStyle = '#ffffff59';
    context.font = `${10 * ratio}px ui-monospace, Menlo, Consolas, monospace`;
    for (const ring of RINGS_M.filter((metre) => metre <= reach * 1.2 && metre >= reach / 6)) {
      context.beginPath();
      for (let at = 0; at <= 96; at++) {
        const angle = (at / 96) * 2 * Math.PI, [x, y, far] = view(ring * Math.cos(angle), ring * Math.sin(angle), span[0]);
        if (far > 0.05) context.lineTo(x, y);
      }
      context.stroke();
      const [x, y, far] = view(ring * Math.cos(orbit.turn + .9), ring * Math.sin(orbit.turn + .9), span[0]);
      if (far > 0.05) context.fillText(`${ring} m`, x + 3 * ratio, y - 3 * ratio);
    }
    const [x0, y0] = view(0, 0, 0), [x1, y1] = view(reach * 0.12, 0, 0);  // where the sensor is, and looks
    context.strokeStyle = '#eceae4';
    context.lineWidth = 2 * ratio;
    context.beginPath();
    context.moveTo(x0, y0);
    context.lineTo(x1, y1);
    context.stroke();
    context.fillStyle = '#eceae4';
    context.beginPath();
    context.arc(x0, y0, 3 * ratio, 0, 7);
    context.fill();
  }

  canvas.onpointerdown = (event) => canvas.setPointerCapture(event.pointerId);
  canvas.onpointermove = (event) => {
    if (!canvas.hasPointerCapture(event.pointerId)) return;
    orbit.turn -= event.movementX * 0.008;
    orbit.tilt = Math.min(1.5, Math.max(-0.3, orbit.tilt + event.movementY * 0.006));
    draw();
  };
  canvas.addEventListener('wheel', (event) => {
    event.preventDefault();
    orbit.away = Math.min(1.5, Math.max(-2.5, orbit.away + event.deltaY * 0.001));
    draw();
  }, { passive: false });
  new ResizeObserver(draw).observe(canvas);

  const paint = (held) => {
    cloud = held;
    if (!span && held.n) {  // colours and distance keep still while the cloud moves
      const part = (values, share) => values[Math.floor(share * (values.length - 1))];
      const column = (of) => Float32Array.from({ length: held.n }, (_, at) => of(held.xyz, at * held.k)).sort();
      const heights = column((xyz, at) => xyz[at + 2]), ranges = column((xyz, at) => Math.hypot(xyz[at], xyz[at + 1]));
      span = [part(heights, .02), Math.max(part(heights, .98), part(heights, .02) + .01)];
      reach = Math.max(part(ranges, .9), .1);
      top.textContent = `${metres(span[1])} m`;
      foot.textContent = `${metres(span[0])} m`;
      scale.hidden = false;
    }
    span ??= [0, 1];
    reach ||= 1;
    draw();
  };
  paint.orbit = orbit;
  return paint;
}
