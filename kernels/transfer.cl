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

#if TOP
/* x^(1/4) within 3e-7 of itself: a guess at x^(-1/4) by exponent arithmetic, then a minimax polynomial in its error. */
inline float fourth_root(float x) {
  float guess = as_float(0x4f581000 - (as_int(x) >> 2));
  float root = x * guess * guess * guess, d = 1.0f - root * guess;
  return root * (1.000000061f + d * (0.750000499f + d * (0.6561759444f
               + d * (0.6013772391f + d * (0.5763343444f + d * 0.5538296185f)))));
}

/* The code of x. encode(x) is a minimax polynomial in the fourth root, within 6e-7 on 0..1: a code can differ from the
 * exactly rounded one only where x lies that near to the border between two. */
inline SAMPLE code_of(float x) {
  x = unit(x);
  float t = fourth_root(x);
  float power = -0.05844407142f + t * (0.1235540544f + t * (1.461571078f + t * (-1.155788569f
              + t * (1.208537755f + t * (-0.897374294f + t * (0.3939299771f + t * -0.07598623589f))))));
  return (SAMPLE)(int)(TOP * (x <= 0.0031308f ? 12.92f * x : power) + 0.5f);
}
#else
#define code_of(x) srgb_of(x)
#endif

inline float relit(float x, float log_r) { return x + (x + EPSILON) * (exp2_of(log_r) - 1.0f); }

/* Relight the pixel at `from` into `to`: at `offset` from the middle of its cell along the row, with the vertical
 * weights `down`, amid the nodes `near` of its own and the eight cells around. A call would not be vectorised. */
__attribute__((always_inline)) inline void relight(__global const SAMPLE *from, __global SAMPLE *to, __global const float *table,
                    const float4 *near, const float *down, float offset) {
  float g = unit(0.25f / WHOLE * ((float)from[0] + 2.0f * (float)from[1] + (float)from[2])) * (1.0f / SIGMA);
  float across[3], total = 0.0f, r = 0.0f, s = 0.0f, t = 0.0f;
  spline(offset, across);
#pragma unroll
  for (int k = 0; k < 9; ++k) {
    float distance = g - near[k].w;
    float weight = down[k / 3] * across[k % 3] * rough_reciprocal(1.0f + distance * distance);
    total += weight;
    r += weight * near[k].x;
    s += weight * near[k].y;
    t += weight * near[k].z;
  }
  float scale = 1.0f / total;
  SAMPLE red = code_of(relit(DECODE(from[0]), r * scale));
  SAMPLE green = code_of(relit(DECODE(from[1]), s * scale));
  SAMPLE blue = code_of(relit(DECODE(from[2]), t * scale));
  to[0] = red;
  to[1] = green;
  to[2] = blue;
}

/* Item (k, y): row y of a band whose first row in the photo is `top`, in the cells k * run .. of that row. nodes:
 * (rows + 2, columns + 2) of (log2 R, lightness / SIGMA), the border repeated. */
__kernel void transfer(__global const SAMPLE *restrict photo, __global const float4 *restrict nodes,
                       __global const float *restrict table, __global SAMPLE *restrict result,
                       int height, int width, int rows, int columns, int top, int run) {
  int y = get_global_id(1), begin = get_global_id(0) * run, end = columns - begin < run ? columns : begin + run;
  long centre = (2 * (long)(top + y) + 1) * rows;
  int i = (int)(centre / (2 * (long)height));
  float down[3], step = (float)columns / width;
  spline((float)(centre - (2 * (long)i + 1) * height) / (2.0f * height), down);
  for (int j = begin; j < end; ++j) {
    float4 near[9];
    for (int k = 0; k < 9; ++k) near[k] = nodes[(i + k / 3) * (columns + 2) + j + k % 3];
    int first = first_pixel(j, width, columns), count = first_pixel(j + 1, width, columns) - first;
    float offset = (float)((2 * (long)first + 1) * columns - (2 * (long)j + 1) * width) / (2.0f * width);
    size_t start = 3 * ((size_t)y * width + first);
    __global const SAMPLE *restrict from = photo + start;
    __global SAMPLE *restrict to = result + start;
    /* As many at a time as the device has lanes, the last of them twice if need be: no remainder is left to be done
     * one by one. Of wide cells, a quarter of the time went there. */
    int lanes = count < LANES ? count : LANES;
    for (int x = 0; x < count; x += lanes) {
      int at = x + lanes < count ? x : count - lanes;
      if (lanes == LANES) {
#pragma clang loop vectorize_width(LANES) interleave_count(1)
        for (int k = at; k < at + LANES; ++k) relight(from + 3 * k, to + 3 * k, table, near, down, offset + step * k);
      } else {
        for (int k = at; k < at + lanes; ++k) relight(from + 3 * k, to + 3 * k, table, near, down, offset + step * k);
      }
    }
  }
}
