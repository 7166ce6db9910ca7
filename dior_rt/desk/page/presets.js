// Ready-made lights: shapes for a photo of any size, to be changed like drawn ones.

import { kelvinToRgb } from './color.js';
import { newLight, newShape } from './model.js';
import { t } from './strings.js';

/** A soft pool of light; centre and half axes in shares of the photo's sides. */
const glow = ([w, h], x, y, rx, ry, fields) =>
  newShape({ kind: 'glow', points: [[x * w, y * h], [(x + rx) * w, y * h], [x * w, (y + ry) * h]].map(rounded), softness: 1, ...fields });

const gradient = ([w, h], from, to, fields) =>
  newShape({ kind: 'gradient', points: [from, to].map(([x, y]) => rounded([x * w, y * h])), softness: 1, ...fields });

const rounded = (point) => point.map((x) => Math.round(x * 10) / 10);
const kelvin = (k) => kelvinToRgb(k).map((c) => Math.round(c * 1e4) / 1e4);

const PRESETS = {
  blank: () => ({}),
  key: (size) => ({ reach: 0.35, shapes: [glow(size, 0.28, 0.3, 0.5, 0.6, { color: kelvin(5200), intensity: 2 })] }),
  fill: (size) => ({ reach: null, shapes: [glow(size, 0.75, 0.55, 0.65, 0.75, { color: kelvin(6500), intensity: 0.35 })] }),
  rim: (size) => ({
    reach: 0.1,
    shapes: [gradient(size, [1, 0.3], [0.78, 0.4], { color: kelvin(7200), intensity: 1.6 }), gradient(size, [0, 0.3], [0.14, 0.35], { color: kelvin(7200), intensity: 0.8 })],
  }),
  windowLeft: (size) => ({ reach: null, shapes: [gradient(size, [0, 0.35], [0.75, 0.6], { color: kelvin(6000), intensity: 1.8 })] }),
  windowRight: (size) => ({ reach: null, shapes: [gradient(size, [1, 0.35], [0.25, 0.6], { color: kelvin(6000), intensity: 1.8 })] }),
  candle: (size) => ({
    reach: 0.3,
    shapes: [glow(size, 0.5, 0.7, 0.42, 0.5, { color: kelvin(2400), intensity: 1 }), glow(size, 0.5, 0.74, 0.15, 0.2, { color: kelvin(2500), intensity: 2.5 })],
  }),
  sunset: (size) => ({ reach: null, shapes: [gradient(size, [0, 0.75], [0.9, 0.35], { color: kelvin(2600), intensity: 2.2 })] }),
  moonlight: (size) => ({
    blend: 'multiply', reach: null,
    shapes: [gradient(size, [0.5, 20], [0.5, 22], { color: [0.16, 0.24, 0.42] }), gradient(size, [0.3, 0], [0.6, 1.1], { color: [0.34, 0.46, 0.72] })],
  }),
  background: (size) => ({
    blend: 'multiply', reach: null,
    shapes: [gradient(size, [0.5, 20], [0.5, 22], { color: [1, 1, 1], intensity: 0.22 }), glow(size, 0.5, 0.55, 0.48, 0.6, { erase: true, softness: 0.7 })],
  }),
  around: (size) => ({ reach: null, shapes: [gradient(size, [0.5, 20], [0.5, 22], { color: kelvin(6500), intensity: 0.4 })] }),
};

export const presetNames = Object.keys(PRESETS);

/** A light by the name of a preset, for a photo of [width, height]. */
export function presetLight(name, size) {
  return newLight({ name: t.presets[name], ...PRESETS[name](size) });
}
