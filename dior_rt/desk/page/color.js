// Light as numbers: linear RGB in sRGB's primaries, 1 = display white.

export const NEUTRAL_KELVIN = 6500;

export const encode = (x) => (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055);
export const decode = (x) => (x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4);
export const luminance = ([r, g, b]) => 0.2126 * r + 0.7152 * g + 0.0722 * b;

const brightestOne = (rgb) => {
  const most = Math.max(...rgb, 1e-9);
  return rgb.map((c) => Math.max(c, 0) / most);
};

/** Planck's locus as linear RGB with its greatest channel 1 (Kim et al. 2002 for the chromaticity). */
function planck(kelvin) {
  const u = 1000 / kelvin;
  const x = kelvin <= 4000
    ? -0.2661239 * u ** 3 - 0.234358 * u ** 2 + 0.8776956 * u + 0.17991
    : -3.0258469 * u ** 3 + 2.1070379 * u ** 2 + 0.2226347 * u + 0.24039;
  const y = kelvin <= 2222
    ? -1.1063814 * x ** 3 - 1.3481102 * x ** 2 + 2.18555832 * x - 0.20219683
    : kelvin <= 4000
      ? -0.9549476 * x ** 3 - 1.37418593 * x ** 2 + 2.09137015 * x - 0.16748867
      : 3.081758 * x ** 3 - 5.8733867 * x ** 2 + 3.75112997 * x - 0.37001483;
  const [X, Z] = [x / y, (1 - x - y) / y];
  return [3.2406 * X - 1.5372 - 0.4986 * Z, -0.9689 * X + 1.8758 + 0.0415 * Z, 0.0557 * X - 0.204 + 1.057 * Z].map((c) => Math.max(c, 0));
}

/** A black body's light, white at NEUTRAL_KELVIN. */
export function kelvinToRgb(kelvin) {
  const white = planck(NEUTRAL_KELVIN);
  return brightestOne(planck(kelvin).map((c, i) => c / white[i]));
}

/** A pure hue, degrees, as linear RGB. */
export function hueToRgb(hue) {
  const channel = (shift) => Math.min(1, Math.max(0, Math.abs(((hue / 60 + shift) % 6) - 3) - 1));
  return [channel(0), channel(4), channel(2)];
}

/** The brush's colour: warmth, bent towards a hue as saturation asks; its greatest channel is 1. */
export function mixColor({ kelvin, hue, saturation }) {
  const warm = kelvinToRgb(kelvin);
  const pure = hueToRgb(hue);
  return brightestOne(warm.map((c, i) => c * (1 - saturation + saturation * pure[i]))).map(round);
}

/** Hue and saturation of linear RGB, for the eyedropper. */
export function hueOf(rgb) {
  const [r, g, b] = rgb;
  const [most, least] = [Math.max(r, g, b), Math.min(r, g, b)];
  const spread = most - least;
  if (spread < 1e-6) return { hue: 0, saturation: 0 };
  const sixth = most === r ? ((g - b) / spread + 6) % 6 : most === g ? (b - r) / spread + 2 : (r - g) / spread + 4;
  return { hue: Math.round(sixth * 60), saturation: Math.round((100 * spread) / most) / 100 };
}

const round = (x) => Math.round(x * 1e4) / 1e4;

/** CSS colour of linear RGB; what is too bright is clipped. */
export function toCss(rgb, alpha = 1) {
  const code = (c) => Math.round(255 * encode(Math.min(1, Math.max(0, c))));
  return `rgb(${rgb.map(code).join(' ')} / ${alpha})`;
}

export const toHex = (rgb) => `#${rgb.map((c) => Math.round(255 * encode(Math.min(1, Math.max(0, c)))).toString(16).padStart(2, '0')).join('')}`;
export const fromHex = (hex) => [1, 3, 5].map((i) => round(decode(parseInt(hex.slice(i, i + 2), 16) / 255)));
