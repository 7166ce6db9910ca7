/* Brush strokes over a band of rows; the equations stand in draw.py. */

typedef struct { float x0, y0, x1, y1, radius, softness, strength; int stroke; } Segment;

inline float distance_squared(Segment s, float x, float y) {
  float dx = s.x1 - s.x0, dy = s.y1 - s.y0, px = x - s.x0, py = y - s.y0;
  float length = dx * dx + dy * dy;
  float along = clamp((px * dx + py * dy) / (length > 0.0f ? length : 1.0f), 0.0f, 1.0f);
  px -= along * dx;
  py -= along * dy;
  return px * px + py * py;
}

/* Lay one stroke over what is there: rgb * mask and mask. */
inline float4 lay_over(float4 under, Segment s, float nearest, float4 light) {
  float t = clamp((s.radius + 0.5f - sqrt(nearest)) / (1.0f + s.softness * s.radius), 0.0f, 1.0f);
  float cover = s.strength * (t + s.softness * (t * t * (3.0f - 2.0f * t) - t));
  return under * (1.0f - cover) + light * cover;
}

/* Item (tile column, y): the pixels of one tile on row y of a band whose first row is `top`. The segments that may touch
 * a tile are numbered entries[first[tile]] .. entries[first[tile + 1] - 1], in the order of their strokes. */
__kernel void draw(__global const Segment *restrict segments, __global const float4 *restrict lights,
                   __global const int *restrict first, __global const int *restrict entries,
                   __global float *restrict light, __global float *restrict mask, int width, int top) {
  int column = get_global_id(0), y = get_global_id(1), columns = get_global_size(0);
  int tile = (top + y) / TILE * columns + column;
  for (int x = column * TILE; x < min((column + 1) * TILE, width); ++x) {
    float4 sum = (float4)(0.0f);
    for (int k = first[tile]; k < first[tile + 1];) {
      Segment s = segments[entries[k]];
      float nearest = INFINITY;
      for (int stroke = s.stroke; k < first[tile + 1] && segments[entries[k]].stroke == stroke; ++k)
        nearest = fmin(nearest, distance_squared(segments[entries[k]], x + 0.5f, top + y + 0.5f));
      sum = lay_over(sum, s, nearest, lights[s.stroke]);
    }
    size_t i = (size_t)y * width + x;
    float scale = sum.w > 0.0f ? 1.0f / sum.w : 0.0f;
    light[3 * i] = sum.x * scale;
    light[3 * i + 1] = sum.y * scale;
    light[3 * i + 2] = sum.z * scale;
    mask[i] = sum.w;
  }
}
