/* The sRGB curve of IEC 61966-2-1, for samples of one kind.
 *
 * Built with SAMPLE = uchar, ushort or float, and TOP = 255, 65535 or 0 (float). Integers are decoded through a table of
 * every code and encoded through a table of buckets: both are exact. Floats take the powers as
 * exp2(p * log2(x)), from the two polynomials below.
 *
 * Loops over pixels call no built-in functions: PoCL does not inline its own, and a call keeps the compiler from
 * vectorising the loop, which costs a factor of six.
 */

/* log2(x) of a normal x > 0: x = 2^e * m, m in sqrt(1/2)..sqrt(2), and the series of atanh in (m - 1) / (m + 1). */
inline float log2_of(float x) {
  int bits = as_int(x) - 0x3f3504f3;
  float m = as_float((bits & 0x007fffff) + 0x3f3504f3);
  float s = (m - 1.0f) / (m + 1.0f), q = s * s;
  return (float)(bits >> 23)
       + s * (2.8853900818f + q * (0.9617966939f + q * (0.5770780164f + q * (0.4121985831f + q * 0.3205988980f))));
}

/* 2^y for y in -126..127, within 2e-7 of itself, and exactly 1 at 0: the nearest integer through the exponent's bits
 * (adding 1.5 * 2^23 rounds to it), the rest, in -1/2..1/2, by a minimax polynomial. */
inline float exp2_of(float y) {
  float whole = (y + 12582912.0f) - 12582912.0f, f = y - whole;
  float p = 1.0f + f * (0.6931472657f + f * (0.2402225081f
          + f * (0.05550184488f + f * (0.009671327265f + f * 0.001344868755f))));
  return p * as_float(((int)whole + 127) << 23);
}

/* The curve for any float; infinities and NaN stay what they are. */
inline float linear_of(float v) {
  float base = v > 0.04045f ? v : 0.04045f;
  float y = 2.4f * log2_of((base + 0.055f) / 1.055f);
  float x = v <= 0.04045f ? v / 12.92f : y < 127.0f ? exp2_of(y) : INFINITY;
  return v - v == 0.0f ? x : v;
}

inline float srgb_of(float x) {
  float base = x > 0.0031308f ? x : 0.0031308f;
  float power = 1.055f * exp2_of(log2_of(base) / 2.4f) - 0.055f;
  float v = x <= 0.0031308f ? 12.92f * x : power;
  return x - x == 0.0f ? v : x;
}

#if TOP
#define DECODE(sample) light_of[sample]
#define ENCODE(x) nearest_code(x, code_of)

/* The nearest code of x, exactly: see EncodeTable in color.py. NaN compares as less than FLOOR. */
inline SAMPLE nearest_code(float x, __global const int *code_of) {
  x = x > FLOOR ? x : FLOOR;
  x = x < 1.0f ? x : 1.0f;
  return (SAMPLE)((code_of[(as_int(x) >> SHIFT) - (as_int(FLOOR) >> SHIFT)] + as_int(x)) >> SHIFT);
}

/* Item k: samples k * run .. of `size`. */
__kernel void decode(__global const SAMPLE *restrict picture, __global const float *restrict light_of,
                     __global float *restrict linear, int size, int run) {
  int first = get_global_id(0) * run, stop = size - first < run ? size : first + run;
  for (int i = first; i < stop; ++i) linear[i] = DECODE(picture[i]);
}

__kernel void encode(__global const float *restrict linear, __global const int *restrict code_of,
                     __global SAMPLE *restrict picture, int size, int run) {
  int first = get_global_id(0) * run, stop = size - first < run ? size : first + run;
  for (int i = first; i < stop; ++i) picture[i] = ENCODE(linear[i]);
}
#else
#define DECODE(sample) linear_of(sample)
#define ENCODE(x) srgb_of(x)
#endif

/* The same of floats, whatever the samples: a photo of integers has a grid of floats too. */
__kernel void decode_floats(__global const float *restrict picture, __global float *restrict linear,
                            int size, int run) {
  int first = get_global_id(0) * run, stop = size - first < run ? size : first + run;
  for (int i = first; i < stop; ++i) linear[i] = linear_of(picture[i]);
}

__kernel void encode_floats(__global const float *restrict linear, __global float *restrict picture,
                            int size, int run) {
  int first = get_global_id(0) * run, stop = size - first < run ? size : first + run;
  for (int i = first; i < stop; ++i) picture[i] = srgb_of(linear[i]);
}
