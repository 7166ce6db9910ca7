/* What is kept of a dense Lumi map; the host has drawn the random numbers, see sparsify.py. */

/* Item k: the pixels first[k] .. stop[k] - 1 of the map, on one row, are drawn. */
__kernel void cover(__global const long *restrict first, __global const long *restrict stop, __global float *mask) {
  size_t k = get_global_id(0);
  for (long i = first[k]; i < stop[k]; ++i) mask[i] = 1.0f;
}

/* Item (x, y): a drawn pixel keeps its value. */
__kernel void cut(__global const float *restrict lumi, __global const float *restrict mask, __global float *restrict light) {
  size_t i = get_global_id(1) * get_global_size(0) + get_global_id(0);
  for (int c = 0; c < 3; ++c) light[3 * i + c] = mask[i] > 0.0f ? lumi[3 * i + c] : 0.0f;
}

/* Item (j, i): every pixel of a kept cell gets the cell's mean. The first cell is cut off by (oy, ox). */
__kernel void coarsen(__global const float *restrict lumi, __global const uchar *restrict keep,
                      __global float *restrict light, __global float *restrict mask,
                      int height, int width, int cell, int oy, int ox) {
  int j = get_global_id(0), i = get_global_id(1);
  int left = max(j * cell - ox, 0), right = min((j + 1) * cell - ox, width);
  int top = max(i * cell - oy, 0), bottom = min((i + 1) * cell - oy, height);
  float kept = keep[i * get_global_size(0) + j] ? 1.0f : 0.0f;
  float3 mean = (float3)(0.0f);
  for (int y = top; y < bottom; ++y)
    for (int x = left; x < right; ++x) mean += vload3((size_t)y * width + x, lumi);
  mean = kept > 0.0f ? mean / ((bottom - top) * (float)(right - left)) : (float3)(0.0f);
  for (int y = top; y < bottom; ++y)
    for (int x = left; x < right; ++x) {
      vstore3(mean, (size_t)y * width + x, light);
      mask[(size_t)y * width + x] = kept;
    }
}
