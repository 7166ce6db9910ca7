/* Exact area means: along the rows first, then down the columns of what that left.
 *
 * Cell j of `cells` over `pixels` pixels spans [j, j + 1) * pixels / cells. Overlaps are counted in units of
 * 1 / cells of a pixel, as integers: the span of a cell is `pixels` units, a whole pixel is `cells` units.
 */

typedef struct { int first, stop; float head, tail; } Span;

/* The pixels first..stop - 1 that cell j touches; all weigh 1 but the first (head) and the last (tail), in pixels. */
inline Span span_of(int j, int pixels, int cells) {
  long begin = (long)j * pixels, end = begin + pixels;
  Span span;
  span.first = (int)(begin / cells);
  span.stop = (int)((end + cells - 1) / cells);
  span.head = (float)(min((long)(span.first + 1) * cells, end) - begin) / (float)cells;
  span.tail = (float)(end - (long)(span.stop - 1) * cells) / (float)cells;
  return span;
}

inline float weight_of(Span span, int k) {
  return k == span.first ? span.head : k == span.stop - 1 ? span.tail : 1.0f;
}

#ifdef SAMPLE
#ifdef MASK
/* light * mask and mask; what the mask leaves unspecified is not looked at. */
inline float4 pixel_at(__global const SAMPLE *picture, __global const float *table, __global const MASK *mask, size_t i) {
  float m = (float)mask[i] / WHOLE;
  if (!(m > 0.0f)) return (float4)(0.0f);
  return (float4)(m * LIGHT(picture[3 * i]), m * LIGHT(picture[3 * i + 1]), m * LIGHT(picture[3 * i + 2]), m);
}
#define PIXEL(i) pixel_at(picture, table, mask, i)
#else
#define PIXEL(i) (float4)(LIGHT(picture[3 * (i)]), LIGHT(picture[3 * (i) + 1]), LIGHT(picture[3 * (i) + 2]), 1.0f)
#endif

/* Item (j, y): the sum over cell j of row y of a band, as float4. */
__kernel void sum_rows(__global const SAMPLE *restrict picture, __global const float *restrict table,
#ifdef MASK
                       __global const MASK *restrict mask,
#endif
                       __global float4 *restrict sums, int width, int cells, int top) {
  int j = get_global_id(0), y = get_global_id(1);
  Span span = span_of(j, width, cells);
  size_t row = (size_t)y * width;
  float4 total = span.head * PIXEL(row + span.first);
  for (int x = span.first + 1; x < span.stop - 1; ++x) total += PIXEL(row + x);
  if (span.stop - span.first > 1) total += span.tail * PIXEL(row + span.stop - 1);
  sums[(size_t)(top + y) * cells + j] = total;
}
#endif

/* Item (j, i): the sum over the rows of cell row i, divided by the fourth component: area, or weight of the mask. */
__kernel void mean_columns(__global const float4 *restrict sums, __global float *restrict light,
                           __global float *restrict mask, int height) {
  int j = get_global_id(0), i = get_global_id(1), columns = get_global_size(0), rows = get_global_size(1);
  Span span = span_of(i, height, rows);
  float4 total = (float4)(0.0f);
  for (int y = span.first; y < span.stop; ++y) total += weight_of(span, y) * sums[(size_t)y * columns + j];
  size_t cell = (size_t)i * columns + j;
  float given = total.w > 0.0f ? 1.0f : 0.0f, scale = total.w > 0.0f ? 1.0f / total.w : 0.0f;
  light[3 * cell] = total.x * scale;
  light[3 * cell + 1] = total.y * scale;
  light[3 * cell + 2] = total.z * scale;
  mask[cell] = given;
}
