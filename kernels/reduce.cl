/* Exact area means: along the rows first, then down the columns of what that left. Built after curve.cl. With MASK, the
 * type of a mask whose MASK_WHOLE stands for 1, FAINTEST, what a fainter mask counts as, and LIGHT, how the light's
 * samples are decoded, it is sum_rows of strokes.
 *
 * Cell j of `cells` over `pixels` pixels spans j * pixels / cells .. (j + 1) * pixels / cells. Its ends are computed as
 * integers, in units of 1 / cells of a pixel: what a cell does not touch weighs exactly nothing.
 */

/* The pixels first .. last that a cell touches; all weigh 1 but these two. */
typedef struct { int first, last; float head, tail; } Span;

inline Span span_of(int j, int pixels, int cells) {
  long begin = (long)j * pixels, end = begin + pixels;
  Span span;
  span.first = (int)(begin / cells);
  span.last = (int)((end - 1) / cells);
  long next = (long)(span.first + 1) * cells;
  span.head = (float)((next < end ? next : end) - begin) / (float)cells;
  span.tail = span.last == span.first ? 0.0f : (float)(end - (long)span.last * cells) / (float)cells;
  return span;
}

#ifdef MASK
/* light * mask and mask; what the mask leaves unspecified is not looked at. */
#define PIXEL(i) specified(picture + 3 * (i), light_of, (float)mask[i] / MASK_WHOLE)
inline float4 specified(__global const SAMPLE *pixel, __global const float *light_of, float weight) {
  if (!(weight > 0.0f)) return (float4)(0.0f);
  weight = weight > FAINTEST ? weight : FAINTEST;
  return weight * (float4)(LIGHT(pixel[0]), LIGHT(pixel[1]), LIGHT(pixel[2]), 1.0f);
}
#else
#define PIXEL(i) (float4)(DECODE(picture[3 * (i)]), DECODE(picture[3 * (i) + 1]), DECODE(picture[3 * (i) + 2]), 1.0f)
#endif

/* Item (k, y): row y of a band whose first row in the picture is `top`, summed over each of the cells k * run .. */
__kernel void sum_rows(__global const SAMPLE *restrict picture, __global const float *restrict light_of,
#ifdef MASK
                       __global const MASK *restrict mask,
#endif
                       __global float4 *restrict sums, int width, int columns, int top, int run) {
  int y = get_global_id(1), begin = get_global_id(0) * run, end = columns - begin < run ? columns : begin + run;
  size_t row = (size_t)y * width;
  for (int j = begin; j < end; ++j) {
    Span span = span_of(j, width, columns);
    float4 total = span.head * PIXEL(row + span.first), other = (float4)(0.0f);
    if (span.last > span.first) other = span.tail * PIXEL(row + span.last);
    int x = span.first + 1;
    for (; x + 1 < span.last; x += 2) {
      total += PIXEL(row + x);
      other += PIXEL(row + x + 1);
    }
    if (x < span.last) total += PIXEL(row + x);
    sums[(size_t)(top + y) * columns + j] = total + other;
  }
}

/* Item (k, i): cells k * run .. of row i: the sum over the cell's rows divided by its fourth component, which is the
 * area, or the weight of the mask. */
__kernel void mean_columns(__global const float4 *restrict sums, __global float *restrict light,
                           __global float *restrict mask, int height, int rows, int columns, int run) {
  int i = get_global_id(1), begin = get_global_id(0) * run, end = columns - begin < run ? columns : begin + run;
  Span span = span_of(i, height, rows);
  for (int j = begin; j < end; ++j) {
    float4 total = span.head * sums[(size_t)span.first * columns + j];
    for (int y = span.first + 1; y < span.last; ++y) total += sums[(size_t)y * columns + j];
    if (span.last > span.first) total += span.tail * sums[(size_t)span.last * columns + j];
    size_t cell = (size_t)i * columns + j;
    float scale = total.w > 0.0f ? 1.0f / total.w : 0.0f;
    light[3 * cell] = total.x * scale;
    light[3 * cell + 1] = total.y * scale;
    light[3 * cell + 2] = total.z * scale;
    mask[cell] = total.w > 0.0f ? 1.0f : 0.0f;
  }
}
