/* The sRGB curve of IEC 61966-2-1, for samples of one kind.
 *
 * Built with SAMPLE = uchar, ushort or float, and with TOP = 255, 65535 or 0 (float). Integers are decoded through a
 * table of every code and encoded through a table of rounding thresholds: both are exact. Floats take the powers as
 * exp2(p * log2(x)), from the two polynomials below, whose relative errors are under 1e-7; PoCL's pow is some thirty
 * times slower.
 */

/* log2(x) of a normal x > 0: x = 2^e * m with m in [sqrt(1/2), sqrt(2)), and atanh's series in (m - 1) / (m + 1). */
inline float fast_log2(float x) {
  int bits = as_int(x) - 0x3f3504f3;
  float m = as_float((bits & 0x007fffff) + 0x3f3504f3);
  float s = (m - 1.0f) / (m + 1.0f), s2 = s * s;
  float series = 2.8853900818f + s2 * (0.9617966939f + s2 * (0.5770780164f + s2 * (0.4121985831f + s2 * 0.3205988980f)));
  return (float)(bits >> 23) + s * series;
}

/* 2^y: the power of the nearest integer by its exponent bits, the rest, in -1/2..1/2, by Taylor's series; 1 at 0. */
inline float fast_exp2(float y) {
  y = clamp(y, -126.0f, 127.0f);
  float whole = rint(y), f = y - whole;
  float p = 1.0f + f * (0.69314718056f + f * (0.24022650696f + f * (0.05550410866f
          + f * (0.00961812911f + f * (0.00133335581f + f * (0.00015403530f + f * 0.00001525273f))))));
  return p * as_float(((int)whole + 127) << 23);
}

inline float linear_of(float v) {
  float power = fast_exp2(2.4f * fast_log2((fmax(v, 0.04045f) + 0.055f) / 1.055f));
  float x = v <= 0.04045f ? v / 12.92f : power;
  return isfinite(v) ? x : v;
}

inline float srgb_of(float x) {
  float power = 1.055f * fast_exp2((1.0f / 2.4f) * fast_log2(fmax(x, 0.0031308f))) - 0.055f;
  float v = x <= 0.0031308f ? 12.92f * x : power;
  return isfinite(x) ? v : x;
}

#if TOP
#define DECODE(sample) table[sample]

/* The nearest code of x, exactly: see EncodeTable in color.py. The bits of floor are first << shift. */
inline SAMPLE encode_code(float x, __global const SAMPLE *start, __global const float *threshold) {
  const int shift = TOP == 255 ? 16 : 8;
  float clipped = fmin(fmax(x, FLOOR), 1.0f);
  int code = start[(as_int(clipped) - as_int(FLOOR)) >> shift];
  return (SAMPLE)(code + (clipped >= threshold[code]));
}
#define ENCODE(x) encode_code(x, start, threshold)
#else
#define DECODE(sample) linear_of(sample)
#define ENCODE(x) srgb_of(x)
#endif

/* Item k: samples k * run .. of `size`. */
__kernel void decode(__global const SAMPLE *restrict picture, __global const float *restrict table,
                     __global float *restrict linear, int size, int run) {
  int first = get_global_id(0) * run;
  for (int i = first; i < min(first + run, size); ++i) linear[i] = DECODE(picture[i]);
}

__kernel void encode(__global const float *restrict linear, __global const SAMPLE *restrict start,
                     __global const float *restrict threshold, __global SAMPLE *restrict picture, int size, int run) {
  int first = get_global_id(0) * run;
  for (int i = first; i < min(first + run, size); ++i) picture[i] = ENCODE(linear[i]);
}
