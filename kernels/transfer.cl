/* Quotient light at full size; the equations stand in transfer.py. Built after curve.cl. */

/* 1 / q within 12 % for 1 <= q < 2^60, continuous and falling: the exponent and mantissa bits, negated. The weights of a
 * mean only need a shape, and this one costs an integer subtraction. */
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

/* Item (j, y): the pixels of row y of a band that lie in column j of the cells. nodes: (rows + 2, columns + 2) of
 * (log2 R, lightness), the border repeated; top: the band's first row in the photo. */
__kernel void transfer(__global const SAMPLE *restrict photo, __global const float4 *restrict nodes,
                       __global const float *restrict table, __global const SAMPLE *restrict start,
                       __global const float *restrict threshold, __global SAMPLE *restrict result,
                       int height, int width, int rows, int top) {
  int columns = get_global_size(0), j = get_global_id(0), y = get_global_id(1);
  long v = (2 * (long)(top + y) + 1) * rows;
  int i = (int)(v / (2 * (long)height));
  float down[3];
  spline((float)(v - (2 * (long)i + 1) * height) / (2.0f * height), down);
  float4 near[9];
  for (int k = 0; k < 9; ++k) near[k] = nodes[(i + k / 3) * (columns + 2) + j + k % 3];

  int first = first_pixel(j, width, columns), stop = first_pixel(j + 1, width, columns);
  float step = (float)columns / width;
  float offset = (float)((2 * (long)first + 1) * columns - (2 * (long)j + 1) * width) / (2.0f * width);
  __global const SAMPLE *source = photo + 3 * ((size_t)y * width + first);
  __global SAMPLE *target = result + 3 * ((size_t)y * width + first);
  for (int x = 0; x < stop - first; ++x) {
    SAMPLE red = source[3 * x], green = source[3 * x + 1], blue = source[3 * x + 2];
    float g = clamp(((float)red + 2.0f * (float)green + (float)blue) * (0.25f / SCALE), 0.0f, 1.0f);
    float across[3], weight = 0.0f, r = 0.0f, s = 0.0f, t = 0.0f;
    spline(offset + step * x, across);
#pragma unroll
    for (int k = 0; k < 9; ++k) {
      float d = (g - near[k].w) * (1.0f / SIGMA);
      float w = down[k / 3] * across[k % 3] * rough_reciprocal(1.0f + d * d);
      weight += w;
      r += w * near[k].x;
      s += w * near[k].y;
      t += w * near[k].z;
    }
    float scale = 1.0f / weight;
    float a = DECODE(red), b = DECODE(green), c = DECODE(blue);
    target[3 * x] = ENCODE(a + (a + EPSILON) * (fast_exp2(r * scale) - 1.0f));
    target[3 * x + 1] = ENCODE(b + (b + EPSILON) * (fast_exp2(s * scale) - 1.0f));
    target[3 * x + 2] = ENCODE(c + (c + EPSILON) * (fast_exp2(t * scale) - 1.0f));
  }
}
