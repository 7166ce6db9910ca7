/* Quotient light at full size; the equations stand in transfer.py. Built after curve.cl. */

/* 1 / q within 12 % for 1 <= q < 2^60, continuous and falling: its exponent and mantissa bits, negated. */
inline float rough_reciprocal(float q) { return as_float(0x7ef311c7 - as_int(q)); }

/* The quadratic B-spline at offset d in -1/2..1/2 from the middle of three nodes. */
inline void spline(float d, float *weight) {
  weight[0] = 0.5f * (0.5f - d) * (0.5f - d);
  weight[1] = 0.75f - d * d;
  weight[2] = 0.5f * (0.5f + d) * (0.5f + d);
}

/* The first pixel whose centre lies in cell j or after it. */
inline int first_pixel(int j, int pixels, int cells) {
  return (int)((2 * (long)j * pixels + cells - 1) / (2 * (long)cells));
}

inline float unit(float x) {
  x = x > 0.0f ? x : 0.0f;
  return x < 1.0f ? x : 1.0f;
}

/* x under R = (1 + q)^2: x + (x + e) (R - 1). */
inline float relit(float x, float q) { return x + (x + EPSILON) * (q * (q + 2.0f)); }

#if TOP
#define LIGHTNESS(pixel) ((float)(pixel[0] + 2 * pixel[1] + pixel[2]) * (0.25f / WHOLE / SIGMA))
#else
#define LIGHTNESS(pixel) (unit(0.25f * (pixel[0] + 2.0f * pixel[1] + pixel[2])) * (1.0f / SIGMA))
#endif

/* Relight the pixel at `from` into `to` by r, s, t: sums of sqrt(R) - 1 by weights whose sum is `total`. */
__attribute__((always_inline)) inline void relight(__global const SAMPLE *from, __global SAMPLE *to,
                                                   __global const float *light_of, __global const int *code_of,
                                                   float r, float s, float t, float total) {
  float scale = 1.0f / total;
  SAMPLE red = ENCODE(relit(DECODE(from[0]), r * scale));
  SAMPLE green = ENCODE(relit(DECODE(from[1]), s * scale));
  SAMPLE blue = ENCODE(relit(DECODE(from[2]), t * scale));
  to[0] = red;
  to[1] = green;
  to[2] = blue;
}

/* The same at `offset` from the middle of its cell along the row, amid the nodes `near` of its own cell and the eight
 * around, whose light has been multiplied by their vertical weights `down`. A call would not be vectorised. */
__attribute__((always_inline)) inline void relight_amid(__global const SAMPLE *from, __global SAMPLE *to,
                                                        __global const float *light_of, __global const int *code_of,
                                                        const float4 *near, const float *down, float offset) {
  float g = LIGHTNESS(from), across[3], total = 0.0f, r = 0.0f, s = 0.0f, t = 0.0f;
  spline(offset, across);
#pragma unroll
  for (int k = 0; k < 9; ++k) {
    float distance = g - near[k].w;
    float weight = across[k % 3] * rough_reciprocal(1.0f + distance * distance);
    total += weight * down[k / 3];
    r += weight * near[k].x;
    s += weight * near[k].y;
    t += weight * near[k].z;
  }
  relight(from, to, light_of, code_of, r, s, t, total);
}

/* Item (k, y): row y of a band whose first row in the photo is `top`, in the cells k * run .. of that row. nodes:
 * (rows + 2, columns + 2) of (sqrt(R) - 1, lightness / SIGMA), the border repeated. A cell has LANES pixels or more. */
__kernel void transfer(__global const SAMPLE *restrict photo, __global const float4 *restrict nodes,
                       __global const float *restrict light_of, __global const int *restrict code_of,
                       __global SAMPLE *restrict result,
                       int height, int width, int rows, int columns, int top, int run) {
  int y = get_global_id(1), begin = get_global_id(0) * run, end = columns - begin < run ? columns : begin + run;
  long centre = (2 * (long)(top + y) + 1) * rows;
  int i = (int)(centre / (2 * (long)height));
  float down[3], step = (float)columns / width;
  spline((float)(centre - (2 * (long)i + 1) * height) / (2.0f * height), down);
  for (int j = begin; j < end; ++j) {
    float4 near[9];
    for (int k = 0; k < 9; ++k)
      near[k] = nodes[(i + k / 3) * (columns + 2) + j + k % 3] * (float4)((float3)(down[k / 3]), 1.0f);
    int first = first_pixel(j, width, columns), count = first_pixel(j + 1, width, columns) - first;
    float offset = (float)((2 * (long)first + 1) * columns - (2 * (long)j + 1) * width) / (2.0f * width);
    size_t start = 3 * ((size_t)y * width + first);
    __global const SAMPLE *restrict from = photo + start;
    __global SAMPLE *restrict to = result + start;
    /* As many at a time as the device has lanes, the last of them twice if need be: no remainder is left to be done
     * one by one. Of wide cells, a quarter of the time went there. */
    for (int x = 0; x < count; x += LANES) {
      int at = x + LANES < count ? x : count - LANES;
#pragma clang loop vectorize_width(LANES) interleave_count(1)
      for (int k = at; k < at + LANES; ++k) relight_amid(from + 3 * k, to + 3 * k, light_of, code_of, near, down,
                                                         offset + step * k);
    }
  }
}

/* The same where cells are narrow, whose last lanes would often be idle: here a register of pixels may lie in several
 * cells. nodes: (rows + 2, 3, 4, width), for every pixel of a row those before, at and after its column, a row a
 * quantity; across: (3, width), their weights. A work item takes the pixels k * run .. of its row. */
__kernel void transfer_narrow(__global const SAMPLE *restrict photo, __global const float *restrict nodes,
                              __global const float *restrict across,
                              __global const float *restrict light_of, __global const int *restrict code_of,
                              __global SAMPLE *restrict result, int height, int width, int rows, int top, int run) {
  int y = get_global_id(1), begin = get_global_id(0) * run, end = width - begin < run ? width : begin + run;
  long centre = (2 * (long)(top + y) + 1) * rows;
  int i = (int)(centre / (2 * (long)height));
  float down[3];
  spline((float)(centre - (2 * (long)i + 1) * height) / (2.0f * height), down);
  nodes += (size_t)i * 12 * width;
  photo += (size_t)y * width * 3;
  result += (size_t)y * width * 3;
#pragma clang loop vectorize_width(LANES) interleave_count(1)
  for (int x = begin; x < end; ++x) {
    float g = LIGHTNESS((photo + 3 * x)), total = 0.0f, r = 0.0f, s = 0.0f, t = 0.0f;
#pragma unroll
    for (int k = 0; k < 9; ++k) {
      __global const float *near = nodes + 4 * k * width + x;
      float distance = g - near[3 * width];
      float weight = down[k / 3] * across[k % 3 * width + x] * rough_reciprocal(1.0f + distance * distance);
      total += weight;
      r += weight * near[0];
      s += weight * near[width];
      t += weight * near[2 * width];
    }
    relight(photo + 3 * x, result + 3 * x, light_of, code_of, r, s, t, total);
  }
}
