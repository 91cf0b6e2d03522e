// The shaders: Gaussians as splats, lines, and effects on the whole picture.

export const SPLAT_SHADERS = [`#version 300 es
precision highp float; precision highp int; precision highp usampler2D;
uniform usampler2D data, flags, orders;
uniform ivec2 range;
uniform mat4 view, projection;
uniform vec2 size, turn;
uniform vec3 middle, move;
uniform float factor, coarse, stands;
uniform int tint;
out vec4 colour;
out vec2 off;
out float most;

void main() {
  gl_Position = vec4(2, 2, 2, 1);
  int turn_ = range.x + gl_InstanceID * 256 + gl_VertexID / 4;
  if (turn_ >= range.y) return;
  vec2 corner = vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2.0 - 1.0;
  int index = int(texelFetch(orders, ivec2(turn_ % 1024, turn_ / 1024), 0).x), row = index / 1024, column = index % 1024;
  uvec4 first = texelFetch(data, ivec2(column * 3, row), 0);
  vec4 c = uintBitsToFloat(texelFetch(data, ivec2(column * 3 + 1, row), 0));
  vec2 d = uintBitsToFloat(texelFetch(data, ivec2(column * 3 + 2, row), 0)).xy;
  uint flag = texelFetch(flags, ivec2(column, row), 0).x;
  vec3 place = uintBitsToFloat(first.xyz);
  mat3 spread = mat3(c.x, c.y, c.z, c.y, c.w, d.x, c.z, d.x, d.y);
  if ((flag & 2u) != 0u) {  // what is being moved
    mat3 change = mat3(turn.x, turn.y, 0, -turn.y, turn.x, 0, 0, 0, factor);
    place = change * (place - middle) + middle + move;
    spread = change * spread * transpose(change);
  }
  vec3 at = (view * vec4(place, 1)).xyz;
  float ahead = -at.z, opacity = float(first.w >> 24) / 255.0;
  if (ahead < 0.05 || opacity <= 1.0 / 255.0) return;
  vec2 focal = vec2(projection[0][0], projection[1][1]) * size / 2.0;
  vec2 limit = 1.3 * (1.0 + abs(projection[2].xy)) / vec2(projection[0][0], projection[1][1]);
  vec2 slope = clamp(at.xy / ahead, -limit, limit);
  mat3 linear = mat3(focal.x / ahead, 0, 0, 0, focal.y / ahead, 0, slope.x * focal.x / ahead, slope.y * focal.y / ahead, 0);
  mat3 whole = linear * mat3(view);
  mat3 flat_ = stands * whole * spread * transpose(whole);
  float a = flat_[0][0], b = flat_[0][1], e = flat_[1][1], half_ = (a + e) / 2.0, apart = length(vec2((a - e) / 2.0, b));
  float cube = coarse * length(at) < 0.01 ? 0.0 : 0.95 * coarse * focal.y, grown = max(0.3, cube * cube - max(half_ - apart, 0.0));  // covers its cube
  a += grown;
  e += grown;
  half_ += grown;
  float long_ = half_ + apart, wide = max(half_ - apart, 0.05);
  vec2 axis = abs(b) > 1e-6 ? normalize(vec2(b, long_ - a)) : (a >= e ? vec2(1, 0) : vec2(0, 1));
  most = log(opacity * 255.0);
  float reach = sqrt(2.0 * most);
  vec2 pixels = reach * (corner.x * sqrt(long_) * axis + corner.y * sqrt(wide) * vec2(-axis.y, axis.x));
  vec4 clip = projection * vec4(at, 1);
  gl_Position = vec4(clip.xy / clip.w + 2.0 * pixels / size, 0, 1);
  off = corner * reach;
  vec3 paint = vec3(float(first.w & 255u), float((first.w >> 8) & 255u), float((first.w >> 16) & 255u)) / 204.0;
  if (tint == 1) {
    float grey = dot(paint, vec3(0.3, 0.59, 0.11));
    paint = (flag & 1u) != 0u ? mix(vec3(grey), vec3(0.94, 0.76, 0.45), 0.62) : mix(vec3(grey), vec3(0.5, 0.89, 0.77), 0.22) * 0.85;
  }
  if ((flag & 2u) != 0u) paint = mix(paint, vec3(0.5, 0.89, 0.77), 0.5) + 0.06;
  colour = vec4(paint, opacity);
}`, `#version 300 es
precision highp float;
in vec4 colour;
in vec2 off;
in float most;
out vec4 pixel;
void main() {
  float q = dot(off, off) / 2.0;
  if (q > most) discard;
  float alpha = min(colour.a * exp(-q), 0.99);
  pixel = vec4(colour.rgb * alpha, alpha);
}`];

export const LINE_SHADERS = [`#version 300 es
layout(location = 0) in vec3 place;
uniform mat4 view, projection;
void main() { gl_Position = projection * view * vec4(place, 1); }`, `#version 300 es
precision highp float;
uniform vec4 colour;
out vec4 pixel;
void main() { pixel = vec4(colour.rgb * colour.a, colour.a); }`];

export const FULL_SHADER = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, -1, 1); }`;

/** Leaves open what is not opaque yet. */
export const STOP_SHADER = `#version 300 es
precision highp float;
uniform sampler2D colour;
void main() { if (texelFetch(colour, ivec2(gl_FragCoord.xy), 0).a < 0.99) discard; }`;

export const SHOW_SHADER = `#version 300 es
precision highp float;
uniform sampler2D colour;
uniform vec2 corner;
uniform float gain;
out vec4 pixel;
void main() {
  pixel = texelFetch(colour, ivec2(gl_FragCoord.xy - corner), 0);
  pixel.rgb *= gain;
}`;
