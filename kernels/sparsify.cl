/* What is kept of a dense Lumi map; the host has drawn the random numbers, see sparsify.py. */

/* Item k: the spans k * run .. of `count` are drawn; a span is the pixels first .. stop - 1 of the map. Spans overlap,
 * but all that is ever written is 1. */
__kernel void cover(__global const long *restrict first, __global const long *restrict stop, __global float *mask,
                    int count, int run) {
  int begin = get_global_id(0) * run, end = count - begin < run ? count : begin + run;
  for (int k = begin; k < end; ++k)
    for (long i = first[k]; i < stop[k]; ++i) mask[i] = 1.0f;
}

/* Item k: of the pixels k * run .. of `size`, those drawn keep their value. */
__kernel void cut(__global const float *restrict lumi, __global const float *restrict mask,
                  __global float *restrict light, int size, int run) {
  int begin = get_global_id(0) * run, end = size - begin < run ? size : begin + run;
  for (int i = begin; i < end; ++i)
    for (int c = 0; c < 3; ++c) light[3 * (size_t)i + c] = mask[i] > 0.0f ? lumi[3 * (size_t)i + c] : 0.0f;
}

/* Item (k, i): every pixel of the kept cells k * run .. of row i gets its cell's mean. The first cell is cut off by
 * (oy, ox). */
__kernel void coarsen(__global const float *restrict lumi, __global const uchar *restrict keep,
                      __global float *restrict light, __global float *restrict mask,
                      int height, int width, int cell, int oy, int ox, int columns, int run) {
  int i = get_global_id(1), begin = get_global_id(0) * run, end = columns - begin < run ? columns : begin + run;
  int top = max(i * cell - oy, 0), bottom = min((i + 1) * cell - oy, height);
  for (int j = begin; j < end; ++j) {
    int left = max(j * cell - ox, 0), right = min((j + 1) * cell - ox, width);
    bool kept = keep[i * columns + j];
    float3 mean = (float3)(0.0f);
    for (int y = top; y < bottom && kept; ++y)
      for (int x = left; x < right; ++x) mean += vload3((size_t)y * width + x, lumi);
    mean /= (float)(bottom - top) * (float)(right - left);
    for (int y = top; y < bottom; ++y)
      for (int x = left; x < right; ++x) {
        vstore3(mean, (size_t)y * width + x, light);
        mask[(size_t)y * width + x] = kept ? 1.0f : 0.0f;
      }
  }
}
