// The path of the robot, from above: its path in metres, and its heading at the playhead.

import { AMBER, AURORA } from './colours.js';

/** Radians to the left of x in which a pose looks; null where it does not say. */
export function headingOf(pose, numbers) {
  if (pose.quaternion) {
    const [w, x, y, z] = pose.quaternion.map((column) => numbers[column]);
    return Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z));
  }
  if (pose.yaw !== null) return numbers[pose.yaw] * (pose.degrees ? Math.PI / 180 : 1);
  return null;
}

export function makeMap(canvas, pose) {
  let box = null, path = null, layer = null;

  function layout(curve, width, height) {
    let [x0, x1, y0, y1] = [Infinity, -Infinity, Infinity, -Infinity];
    for (let at = 0; at < curve.n; at++) {
      const x = curve.low[at * curve.k + pose.x], y = curve.low[at * curve.k + pose.y];
      if (!Number.isFinite(x + y)) continue;
      [x0, x1, y0, y1] = [Math.min(x0, x), Math.max(x1, x), Math.min(y0, y), Math.max(y1, y)];
    }
    if (x0 > x1) [x0, x1, y0, y1] = [0, 0, 0, 0];
    const room = Math.max(x1 - x0, y1 - y0, 0.2) * 0.12;
    const scale = Math.min(width / (x1 - x0 + 2 * room), (height - 24) / (y1 - y0 + 2 * room));
    return { scale, x: width / 2 - (scale * (x0 + x1)) / 2, y: height / 2 + 10 + (scale * (y0 + y1)) / 2 };
  }

  const at = (x, y) => [box.x + box.scale * x, box.y - box.scale * y];  // x to the right, y up

  function drawGround(context, width, height, ratio) {
    const step = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 1e4, 1e5].find((metre) => metre * box.scale > 34 * ratio) ?? 1e6;
    context.lineWidth = 1;
    context.fillStyle = '#0f1115';
    context.fillRect(0, 0, width, height);
    for (let n = Math.ceil(-box.x / box.scale / step); n * step * box.scale + box.x < width; n++) {
      context.fillStyle = n === 0 ? '#ffffff26' : '#ffffff0d';
      context.fillRect(Math.round(at(n * step, 0)[0]), 0, 1, height);
    }
    for (let n = Math.ceil((box.y - height) / box.scale / step); box.y - n * step * box.scale > 0; n++) {
      context.fillStyle = n === 0 ? '#ffffff26' : '#ffffff0d';
      context.fillRect(0, Math.round(at(0, n * step)[1]), width, 1);
    }
    const long = step * box.scale, x = width - 12 * ratio - long, y = height - 12 * ratio;
    context.fillStyle = '#c9cace';
    context.fillRect(x, y, long, ratio);
    context.fillRect(x, y - 3 * ratio, ratio, 4 * ratio);
    context.fillRect(x + long - ratio, y - 3 * ratio, ratio, 4 * ratio);
    context.font = `${10.5 * ratio}px ui-monospace, Menlo, Consolas, monospace`;
    context.textAlign = 'center';
    context.fillText(`${step} m`, x + long / 2, y - 5 * ratio);
  }

  function drawPath(context, until, colour, thick) {
    context.strokeStyle = colour;
    context.lineWidth = thick;
    context.lineJoin = 'round';
    context.beginPath();
    let pen = false;
    for (let row = 0; row < path.n && path.times[row] <= until; row++) {
      const x = path.low[row * path.k + pose.x], y = path.low[row * path.k + pose.y];
      if (!Number.isFinite(x + y)) { pen = false; continue; }
      context[pen ? 'lineTo' : 'moveTo'](...at(x, y));
      pen = true;
    }
    context.stroke();
  }

  /** Draws with the series of the whole path, and the numbers at the playhead (either may be missing still). */
  return (curve, numbers, time) => {
    const ratio = Math.min(2, devicePixelRatio || 1), width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
    if (!curve || curve.error || !width || !height) return;
    if (path !== curve || canvas.width !== width || canvas.height !== height) {
      Object.assign(canvas, { width, height });
      path = curve;
      box = layout(curve, width, height);
      layer = Object.assign(document.createElement('canvas'), { width, height });
      const context = layer.getContext('2d');
      drawGround(context, width, height, ratio);
      drawPath(context, Infinity, '#7fe3c440', 1.5 * ratio);
    }
    const context = canvas.getContext('2d');
    context.drawImage(layer, 0, 0);
    drawPath(context, time, AURORA, 2 * ratio);
    if (!numbers || !Number.isFinite(numbers[pose.x] + numbers[pose.y])) return;
    const [x, y] = at(numbers[pose.x], numbers[pose.y]), heading = headingOf(pose, numbers), size = 8 * ratio;
    context.save();
    context.translate(x, y);
    context.fillStyle = AMBER;
    context.beginPath();
    if (heading === null || !Number.isFinite(heading)) context.arc(0, 0, size * .6, 0, 7);
    else {
      context.rotate(-heading);
      const cone = context.createRadialGradient(0, 0, 0, 0, 0, size * 6);
      cone.addColorStop(0, '#f0c27459');
      cone.addColorStop(1, '#f0c27400');
      context.fillStyle = cone;
      context.moveTo(0, 0);
      context.arc(0, 0, size * 6, -.62, .62);
      context.fill();
      context.fillStyle = AMBER;
      context.beginPath();
      context.moveTo(size * 1.5, 0);
      context.lineTo(-size, -size * .85);
      context.lineTo(-size * .55, 0);
      context.lineTo(-size, size * .85);
    }
    context.fill();
    context.restore();
  };
}
