/* Brush strokes over a band of rows; the equations stand in draw.py. */

typedef struct { float x0, y0, x1, y1, radius, softness, strength; int stroke; } Segment;

inline float distance_squared(Segment s, float x, float y) {
  float dx = s.x1 - s.x0, dy = s.y1 - s.y0, px = x - s.x0, py = y - s.y0;
  float length = dx * dx + dy * dy;
  float along = (px * dx + py * dy) / (length > 0.0f ? length : 1.0f);
  along = clamp(along, 0.0f, 1.0f);
  px -= along * dx;
  py -= along * dy;
  return px * px + py * py;
}

/* Lay one stroke over what is there: rgb * mask and mask. */
inline float4 lay_over(float4 under, Segment s, float nearest, float4 light) {
  float t = clamp((s.radius + 0.5f - sqrt(nearest)) / (1.0f + s.softness * s.radius), 0.0f, 1.0f);
  float cover = s.strength * (t + s.softness * (t * t * (3.0f - 2.0f * t) - t));
  return under + cover * (light - under);
}

/* Item (k, y): row y of a band whose first row is `top`, in the tiles k * run .. of that row. The segments that may
 * touch a tile are entries[first[tile]] .. entries[first[tile + 1] - 1], in the order of their strokes. */
__kernel void draw(__global const Segment *restrict segments, __global const float4 *restrict lights,
                   __global const int *restrict first, __global const int *restrict entries,
                   __global float *restrict light, __global float *restrict mask,
                   int width, int columns, int top, int run) {
  int y = get_global_id(1), begin = get_global_id(0) * run, end = columns - begin < run ? columns : begin + run;
  first += (top + y) / TILE * columns;
  for (int x = begin * TILE; x < end * TILE && x < width; ++x) {
    int k = first[x / TILE], stop = first[x / TILE + 1];
    float4 sum = (float4)(0.0f);
    while (k < stop) {
      Segment s = segments[entries[k]];
      float nearest = INFINITY;
      for (; k < stop && segments[entries[k]].stroke == s.stroke; ++k)
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
