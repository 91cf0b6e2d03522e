// Draws Gaussians with WebGL2: one quad each, the nearest first, as space/raster draws them. After each part of them, opaque pixels
// are closed by the depth buffer, so that hidden Gaussians cost nothing.

import { FULL_SHADER, LINE_SHADERS, SHOW_SHADER, SPLAT_SHADERS, STOP_SHADER } from './shaders.js';

const ACROSS = 1024, TEXELS = 3;  // Gaussians in a row of the texture, and texels of each
const BATCH = 256;  // of an instance: one instance for each Gaussian is slow to draw
const PARTS = [0.01, 0.03, 0.06, 0.1, 0.16, 0.24, 0.35, 0.5, 0.7, 1];
const GAMMA = 2.2;  // of the colours: a stop is a factor of 2 in linear light
export const NEAR = 0.05;

export class Drawing {
  constructor(canvas) {
    const gl = canvas.getContext('webgl2', { antialias: false, premultipliedAlpha: true });
    if (!gl) throw new Error('this browser draws no WebGL2; take #webgl off the address.');
    Object.assign(this, { canvas, gl, ready: false, count: 0, coarse: 0, stands: 1, tint: 0, stops: 0, still: { middle: [0, 0, 0], move: [0, 0, 0], turn: 0, factor: 1 } });
    this.preview = this.still;
    this.splats = program(gl, SPLAT_SHADERS);
    this.lines = program(gl, LINE_SHADERS);
    this.stop = program(gl, [FULL_SHADER, STOP_SHADER]);
    this.show = program(gl, [FULL_SHADER, SHOW_SHADER]);
    this.target = { width: 0, height: 0, colour: gl.createTexture(), depth: gl.createRenderbuffer(), whole: gl.createFramebuffer(), shut: gl.createFramebuffer() };
    this.texture = gl.createTexture();
    this.flags = gl.createTexture();
    this.orders = gl.createTexture();
    this.lineBuffer = gl.createBuffer();
    this.quads = gl.createVertexArray();
    gl.bindVertexArray(this.quads);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, Uint16Array.from({ length: 6 * BATCH }, (_, k) => 4 * Math.floor(k / 6) + [0, 1, 2, 2, 1, 3][k % 6]), gl.STATIC_DRAW);
    this.wire = gl.createVertexArray();
    gl.bindVertexArray(this.wire);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.lineBuffer);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
  }

  /** Takes a scene: places, covariances and colours; each Gaussian represents others that were left out. */
  set(scene, stands = 1) {
    const { gl } = this, rows = Math.max(1, Math.ceil(scene.length / ACROSS)), data = new Uint32Array(rows * ACROSS * TEXELS * 4), floats = new Float32Array(data.buffer);
    for (let k = 0; k < scene.length; k += 1) {
      const at = 12 * k, byte = (value) => Math.min(255, Math.max(0, Math.round(value)));
      floats.set(scene.means.subarray(3 * k, 3 * k + 3), at);
      data[at + 3] = byte(204 * scene.colours[3 * k]) | byte(204 * scene.colours[3 * k + 1]) << 8 | byte(204 * scene.colours[3 * k + 2]) << 16 | byte(255 * scene.opacities[k]) << 24;
      floats.set(covariance(scene, k), at + 4);
    }
    upload(gl, this.texture, gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT, ACROSS * TEXELS, rows, data);
    Object.assign(this, { ready: false, stands });
    this.mark(scene, null);
  }

  /** Says of each Gaussian whether it was seen, and whether it is selected. */
  mark(scene, mask) {
    const { gl } = this, rows = Math.max(1, Math.ceil(scene.length / ACROSS)), data = new Uint8Array(rows * ACROSS);
    for (let k = 0; k < scene.length; k += 1) data[k] = (scene.seen[k] ? 0 : 1) | (mask?.[k] ? 2 : 0);
    upload(gl, this.flags, gl.R8UI, gl.RED_INTEGER, gl.UNSIGNED_BYTE, ACROSS, rows, data);
  }

  /** The order to draw in. coarse: each covers a cube of that many metres a metre away; 0: itself. */
  order(order, coarse = 0) {
    const { gl } = this, rows = Math.max(1, Math.ceil(order.length / ACROSS)), data = new Uint32Array(rows * ACROSS);
    data.set(order);
    upload(gl, this.orders, gl.R32UI, gl.RED_INTEGER, gl.UNSIGNED_INT, ACROSS, rows, data);
    Object.assign(this, { ready: true, count: order.length, coarse });
  }

  clear(target = null) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
  }

  /** Paints one view into a part [x, y, width, height] of a framebuffer: matrices as WebGL has them. */
  paint({ view, projection }, [x, y, width, height], wires = [], target = null) {
    const { gl } = this;
    this.resize(width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.whole);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.depthMask(true);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    this.describe(view, projection, width, height);
    PARTS.forEach((share, at) => {
      this.part(Math.floor((PARTS[at - 1] ?? 0) * this.count), Math.floor(share * this.count));
      if (share < 1) this.close();
    });
    gl.disable(gl.DEPTH_TEST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.viewport(x, y, width, height);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(this.show.program);
    gl.uniform2f(this.show.at('corner'), x, y);
    gl.uniform1f(this.show.at('gain'), 2 ** (this.stops / GAMMA));
    this.full(this.show);
    this.draw(wires, view, projection);
  }

  /** What all Gaussians of a view share. */
  describe(view, projection, width, height) {
    const { gl, splats, preview } = this;
    gl.useProgram(splats.program);
    gl.uniform1i(splats.at('data'), 0);
    gl.uniform1i(splats.at('flags'), 1);
    gl.uniform1i(splats.at('orders'), 2);
    gl.uniformMatrix4fv(splats.at('view'), false, view);
    gl.uniformMatrix4fv(splats.at('projection'), false, projection);
    gl.uniform2f(splats.at('size'), width, height);
    gl.uniform1f(splats.at('coarse'), this.coarse);
    gl.uniform1f(splats.at('stands'), this.stands);
    gl.uniform1i(splats.at('tint'), this.tint);
    gl.uniform3fv(splats.at('middle'), preview.middle);
    gl.uniform3fv(splats.at('move'), preview.move);
    gl.uniform2f(splats.at('turn'), preview.factor * Math.cos(preview.turn), preview.factor * Math.sin(preview.turn));
    gl.uniform1f(splats.at('factor'), preview.factor);
  }

  /** Draws the Gaussians of the order from one to another. */
  part(from, to) {
    const { gl } = this;
    if (to <= from) return;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.whole);
    gl.useProgram(this.splats.program);
    [this.texture, this.flags, this.orders].forEach((texture, unit) => { gl.activeTexture(gl.TEXTURE0 + unit); gl.bindTexture(gl.TEXTURE_2D, texture); });
    gl.blendFunc(gl.ONE_MINUS_DST_ALPHA, gl.ONE);
    gl.depthMask(false);
    gl.uniform2i(this.splats.at('range'), from, to);
    gl.bindVertexArray(this.quads);
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * BATCH, gl.UNSIGNED_SHORT, 0, Math.ceil((to - from) / BATCH));
  }

  /** Closes the pixels that are opaque. */
  close() {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.shut);
    gl.depthMask(true);
    this.full(this.stop);
  }

  /** Runs a shader over the whole picture that was painted. */
  full(shader) {
    const { gl } = this;
    gl.useProgram(shader.program);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.target.colour);
    gl.uniform1i(shader.at('colour'), 0);
    gl.bindVertexArray(null);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  draw(wires, view, projection) {
    const { gl, lines } = this;
    gl.useProgram(lines.program);
    gl.uniformMatrix4fv(lines.at('view'), false, view);
    gl.uniformMatrix4fv(lines.at('projection'), false, projection);
    gl.bindVertexArray(this.wire);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.lineBuffer);
    for (const { points, colour } of wires) {
      gl.bufferData(gl.ARRAY_BUFFER, points, gl.STREAM_DRAW);
      gl.uniform4fv(lines.at('colour'), colour);
      gl.drawArrays(gl.LINES, 0, points.length / 3);
    }
    gl.bindVertexArray(null);
  }

  resize(width, height) {
    const { gl, target } = this;
    if (target.width === width && target.height === height) return;
    Object.assign(target, { width, height });
    upload(gl, target.colour, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, width, height, null);
    gl.bindRenderbuffer(gl.RENDERBUFFER, target.depth);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT16, width, height);
    for (const framebuffer of [target.whole, target.shut]) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, target.depth);
    }
    gl.drawBuffers([gl.NONE]);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.whole);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target.colour, 0);
  }
}

/** The columns of a Gaussian's turn, each as long as its deviation along that axis: 9 numbers. */
export function axesOf({ quats, scales }, k) {
  let [w, x, y, z] = [quats[4 * k], quats[4 * k + 1], quats[4 * k + 2], quats[4 * k + 3]];
  const long = Math.hypot(w, x, y, z) || 1, a = scales[3 * k], b = scales[3 * k + 1], c = scales[3 * k + 2];
  [w, x, y, z] = [w / long, x / long, y / long, z / long];
  return [
    a * (1 - 2 * (y * y + z * z)), a * 2 * (x * y + w * z), a * 2 * (x * z - w * y),
    b * 2 * (x * y - w * z), b * (1 - 2 * (x * x + z * z)), b * 2 * (y * z + w * x),
    c * 2 * (x * z + w * y), c * 2 * (y * z - w * x), c * (1 - 2 * (x * x + y * y)),
  ];
}

/** xx, xy, xz, yy, yz, zz. */
export function covariance(scene, k) {
  const m = axesOf(scene, k), sum = (i, j) => m[i] * m[j] + m[i + 3] * m[j + 3] + m[i + 6] * m[j + 6];
  return [sum(0, 0), sum(0, 1), sum(0, 2), sum(1, 1), sum(1, 2), sum(2, 2)];
}

function upload(gl, texture, internal, format, kind, width, height, data) {
  gl.bindTexture(gl.TEXTURE_2D, texture);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, format, kind, data);
}

function program(gl, sources) {
  const made = gl.createProgram();
  [gl.VERTEX_SHADER, gl.FRAGMENT_SHADER].forEach((kind, k) => {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, sources[k]);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
  });
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  const places = {};
  return { program: made, at: (name) => (places[name] ??= gl.getUniformLocation(made, name)) };
}
