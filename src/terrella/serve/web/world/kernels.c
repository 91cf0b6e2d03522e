// The arithmetic of a flow network in WebAssembly (SIMD): maps are float32 [height, width, channels].
// recipes/world_kernels.sh compiles it to kernels.wasm.
#include <wasm_simd128.h>

#define PANEL 8  // outputs that are computed at once: weights are [outputs / PANEL, inputs, PANEL]
#define ROWS 4   // pixels that are computed at once

extern unsigned char __heap_base;
static float patches[ROWS * 8192];

int heap(void) { return (int)&__heap_base; }

static v128_t exponential(v128_t x) {  // within 2e-7, of -87..88
  x = wasm_f32x4_max(wasm_f32x4_splat(-87.0f), wasm_f32x4_min(wasm_f32x4_splat(88.0f), x));
  v128_t whole = wasm_f32x4_nearest(wasm_f32x4_mul(x, wasm_f32x4_splat(1.44269504f)));
  v128_t rest = wasm_f32x4_sub(x, wasm_f32x4_mul(whole, wasm_f32x4_splat(0.693359375f)));
  rest = wasm_f32x4_sub(rest, wasm_f32x4_mul(whole, wasm_f32x4_splat(-2.12194440e-4f)));
  static const float series[] = {1.9875691500e-4f, 1.3981999507e-3f, 8.3334519073e-3f, 4.1665795894e-2f, 1.6666665459e-1f, 5.0000001201e-1f};
  v128_t sum = wasm_f32x4_splat(series[0]);
  for (int i = 1; i < 6; i++) sum = wasm_f32x4_add(wasm_f32x4_mul(sum, rest), wasm_f32x4_splat(series[i]));
  sum = wasm_f32x4_add(wasm_f32x4_add(wasm_f32x4_mul(sum, wasm_f32x4_mul(rest, rest)), rest), wasm_f32x4_splat(1.0f));
  v128_t power = wasm_i32x4_shl(wasm_i32x4_add(wasm_i32x4_trunc_sat_f32x4(whole), wasm_i32x4_splat(127)), 23);
  return wasm_f32x4_mul(sum, power);
}

static v128_t swish(v128_t x) {
  return wasm_f32x4_div(x, wasm_f32x4_add(wasm_f32x4_splat(1.0f), exponential(wasm_f32x4_neg(x))));
}

// Rows [ROWS, inputs] times weights, plus bias; the first `count` rows are written to out [count, outputs].
static void multiply(const float *rows, int inputs, const float *weights, const float *bias, int outputs, float *out, int count) {
  for (int first = 0; first < outputs; first += PANEL, weights += inputs * PANEL) {
    v128_t low = wasm_v128_load(bias + first), high = wasm_v128_load(bias + first + 4);
    v128_t sums[ROWS][2] = {{low, high}, {low, high}, {low, high}, {low, high}};
    const float *w = weights;
    for (int k = 0; k < inputs; k++, w += PANEL) {
      v128_t one = wasm_v128_load(w), two = wasm_v128_load(w + 4);
#pragma unroll
      for (int row = 0; row < ROWS; row++) {
        v128_t value = wasm_v128_load32_splat(rows + row * inputs + k);
        sums[row][0] = wasm_f32x4_add(sums[row][0], wasm_f32x4_mul(value, one));
        sums[row][1] = wasm_f32x4_add(sums[row][1], wasm_f32x4_mul(value, two));
      }
    }
    float kept[PANEL];
    for (int row = 0; row < count; row++) {
      float *at = out + row * outputs + first;
      if (first + PANEL <= outputs) {
        wasm_v128_store(at, sums[row][0]);
        wasm_v128_store(at + 4, sums[row][1]);
      } else {
        wasm_v128_store(kept, sums[row][0]);
        wasm_v128_store(kept + 4, sums[row][1]);
        for (int i = 0; i < outputs - first; i++) at[i] = kept[i];
      }
    }
  }
}

static void copy(float *to, const float *from, int count) {
  int i = 0;
  for (; i + 4 <= count; i += 4) wasm_v128_store(to + i, wasm_v128_load(from + i));
  for (; i < count; i++) to[i] = from[i];
}

// A convolution with zero padding of x [height, width, channels]: out [(height + 2 pad - side) / stride + 1, ..., outputs].
void convolve(const float *x, int height, int width, int channels, int side, int stride, int pad, const float *weights, const float *bias, int outputs, float *out) {
  int tall = (height + 2 * pad - side) / stride + 1, wide = (width + 2 * pad - side) / stride + 1, inputs = side * side * channels;
  for (int first = 0; first < tall * wide; first += ROWS) {
    int count = tall * wide - first < ROWS ? tall * wide - first : ROWS;
    for (int row = 0; row < count; row++) {
      int y = (first + row) / wide * stride - pad, left = (first + row) % wide * stride - pad;
      float *patch = patches + row * inputs;
      for (int dy = 0; dy < side; dy++, y++)
        for (int dx = 0; dx < side; dx++, patch += channels) {
          if (y >= 0 && y < height && left + dx >= 0 && left + dx < width) copy(patch, x + (y * width + left + dx) * channels, channels);
          else for (int i = 0; i < channels; i++) patch[i] = 0;
        }
    }
    multiply(patches, inputs, weights, bias, outputs, out + first * outputs, count);
  }
}

// Group normalisation of x [pixels, channels] (a multiple of 4 a group, or any), then times `scale`, plus `shift`, and SiLU.
void normalise(const float *x, int pixels, int channels, int groups, const float *gain, const float *bias, const float *scale, const float *shift, float *out) {
  int size = channels / groups;
  for (int group = 0; group < groups; group++) {
    double sum = 0, squares = 0;
    for (int p = 0; p < pixels; p++) {
      const float *at = x + p * channels + group * size;
      float part = 0, square = 0;
      for (int i = 0; i < size; i++) { part += at[i]; square += at[i] * at[i]; }
      sum += part; squares += square;
    }
    double count = (double)pixels * size, mean = sum / count;
    float spread = (float)(1.0 / __builtin_sqrt(squares / count - mean * mean + 1e-5));
    for (int i = group * size; i < (group + 1) * size; i++) {
      float times = spread * gain[i] * scale[i], plus = (bias[i] - (float)mean * spread * gain[i]) * scale[i] + shift[i];
      for (int p = 0; p < pixels; p++) out[p * channels + i] = x[p * channels + i] * times + plus;
    }
  }
  for (int i = 0; i < pixels * channels; i += 4) wasm_v128_store(out + i, swish(wasm_v128_load(out + i)));
}

// SiLU in place; count is rounded up to a multiple of 4.
void silu(float *x, int count) {
  for (int i = 0; i < count; i += 4) wasm_v128_store(x + i, swish(wasm_v128_load(x + i)));
}

// x += y; count is rounded up to a multiple of 4.
void add(float *x, const float *y, int count) {
  for (int i = 0; i < count; i += 4) wasm_v128_store(x + i, wasm_f32x4_add(wasm_v128_load(x + i), wasm_v128_load(y + i)));
}

// Self-attention of [tokens, 3 * width] = queries, keys and values: out [tokens, width]. scores: room for `tokens` numbers.
void attend(const float *given, int tokens, int width, int heads, float *scores, float *out) {
  int size = width / heads;
  float root = 1.0f / __builtin_sqrtf((float)size);
  for (int head = 0; head < heads; head++)
    for (int one = 0; one < tokens; one++) {
      const float *query = given + one * 3 * width + head * size;
      float most = -1e30f, total = 0;
      for (int other = 0; other < tokens; other++) {
        const float *key = given + other * 3 * width + width + head * size;
        float dot = 0;
        for (int i = 0; i < size; i++) dot += query[i] * key[i];
        scores[other] = dot * root;
        if (scores[other] > most) most = scores[other];
      }
      for (int other = 0; other < tokens; other++) {
        scores[other] = wasm_f32x4_extract_lane(exponential(wasm_f32x4_splat(scores[other] - most)), 0);
        total += scores[other];
      }
      float *to = out + one * width + head * size;
      for (int i = 0; i < size; i++) to[i] = 0;
      for (int other = 0; other < tokens; other++) {
        const float *value = given + other * 3 * width + 2 * width + head * size;
        float share = scores[other] / total;
        for (int i = 0; i < size; i++) to[i] += share * value[i];
      }
    }
}

// x [height, width, side * side * channels], squares of pixels row by row, as [height * side, width * side, channels].
void unfold(const float *x, int height, int width, int side, int channels, float *out) {
  for (int y = 0; y < height; y++)
    for (int left = 0; left < width; left++)
      for (int dy = 0; dy < side; dy++, x += side * channels)
        copy(out + ((y * side + dy) * width + left) * side * channels, x, side * channels);
}
