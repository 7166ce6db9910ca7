/* Exact area means: down the columns first, into one row of sums for each row of the grid, then along these. Built
 * after curve.cl. Strokes may be of other types than the photo: LIGHT, decoded by DECODE_LIGHT, and MASK, whose
 * MASK_WHOLE stands for 1. A mask fainter than FAINTEST counts as that.
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

inline float overlap(Span span, int x) { return x == span.first ? span.head : x == span.last ? span.tail : 1.0f; }

/* Item (k, i): of the samples k * run .. of `width`, the mean over those of the picture's rows top .. bottom - 1 that
 * lie in row i of the grid. sums: a row of `width` for each row of the grid, to which every band of rows adds. */
__kernel void sum_photo(__global const SAMPLE *restrict picture, __global const float *restrict light_of,
                        __global float *restrict sums, int width, int height, int rows, int top, int bottom, int run) {
  int i = get_global_id(1), begin = get_global_id(0) * run, end = width - begin < run ? width : begin + run;
  Span span = span_of(i, height, rows);
  sums += (size_t)i * width;
  for (int y = span.first > top ? span.first : top; y <= span.last && y < bottom; ++y) {
    float weight = overlap(span, y) * rows / height;
    __global const SAMPLE *row = picture + (size_t)(y - top) * width;
    for (int x = begin; x < end; ++x) sums[x] += weight * DECODE(row[x]);
  }
}

/* light * mask and mask. */
inline float4 specified(__global const LIGHT *pixel, __global const float *light_of, float weight) {
  weight = weight > FAINTEST ? weight : FAINTEST;
  return weight * (float4)(DECODE_LIGHT(pixel[0]), DECODE_LIGHT(pixel[1]), DECODE_LIGHT(pixel[2]), 1.0f);
}

/* The same of strokes, by pixels: sums of light * mask and of mask. What the mask leaves unspecified is not looked
 * at. */
__kernel void sum_strokes(__global const LIGHT *restrict light, __global const MASK *restrict mask,
                          __global const float *restrict light_of, __global float4 *restrict sums,
                          int width, int height, int rows, int top, int bottom, int run) {
  int i = get_global_id(1), begin = get_global_id(0) * run, end = width - begin < run ? width : begin + run;
  Span span = span_of(i, height, rows);
  sums += (size_t)i * width;
  for (int y = span.first > top ? span.first : top; y <= span.last && y < bottom; ++y) {
    size_t row = (size_t)(y - top) * width;
    for (int x = begin; x < end; ++x)
      if (mask[row + x] > 0)
        sums[x] += overlap(span, y) * specified(light + 3 * (row + x), light_of, mask[row + x] / MASK_WHOLE);
  }
}

/* Item (k, i): the means of the cells k * run .. of row i. A column has `channels` sums: of light and, if four, of what
 * it weighs; if three, all weigh the same. */
__kernel void mean_cells(__global const float *restrict sums, __global float *restrict light,
                         __global float *restrict mask, int channels, int width, int columns, int run) {
  int i = get_global_id(1), begin = get_global_id(0) * run, end = columns - begin < run ? columns : begin + run;
  sums += (size_t)i * width * channels;
  for (int j = begin; j < end; ++j) {
    Span span = span_of(j, width, columns);
    float4 total = (float4)(0.0f);
    for (int x = span.first; x <= span.last; ++x) {
      __global const float *at = sums + (size_t)channels * x;
      total += overlap(span, x) * (float4)(at[0], at[1], at[2], channels == 4 ? at[3] : 1.0f);
    }
    size_t cell = (size_t)i * columns + j;
    float scale = total.w > 0.0f ? 1.0f / total.w : 0.0f;
    light[3 * cell] = total.x * scale;
    light[3 * cell + 1] = total.y * scale;
    light[3 * cell + 2] = total.z * scale;
    mask[cell] = total.w > 0.0f ? 1.0f : 0.0f;
  }
}
