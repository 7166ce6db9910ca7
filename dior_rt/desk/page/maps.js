// Lumi maps in false colour: the luminance of light in stops, dark blue to white.

import { luminance } from './color.js';

export const STOPS = [-5, 3]; // log2 of light at the ends of the scale
const COLORS = [[10, 10, 40], [40, 50, 140], [30, 125, 160], [60, 170, 110], [200, 190, 60], [240, 130, 40], [230, 70, 60], [255, 235, 225]];

/** The colour of light, sRGB 0..255. */
function falseColor(light) {
  const stops = Math.log2(Math.max(light, 1e-6));
  const at = (Math.min(1, Math.max(0, (stops - STOPS[0]) / (STOPS[1] - STOPS[0])))) * (COLORS.length - 1);
  const i = Math.min(COLORS.length - 2, Math.floor(at));
  return COLORS[i].map((c, channel) => c + (at - i) * (COLORS[i + 1][channel] - c));
}

/** A map {rows, columns, channels, data} as a canvas; where a fourth channel is 0 nothing is asked for, and it is faint. */
export function mapCanvas({ rows, columns, channels, data }) {
  const image = new ImageData(columns, rows);
  for (let i = 0; i < rows * columns; i += 1) {
    const light = luminance(data.subarray(i * channels, i * channels + 3));
    image.data.set([...falseColor(light), channels === 4 && !data[i * channels + 3] ? 70 : 235], 4 * i);
  }
  const canvas = new OffscreenCanvas(columns, rows);
  canvas.getContext('2d').putImageData(image, 0, 0);
  return canvas;
}

/** Paint the scale of the false colours into a canvas. */
export function drawScale(canvas) {
  const ctx = canvas.getContext('2d');
  for (let x = 0; x < canvas.width; x += 1) {
    const stops = STOPS[0] + ((STOPS[1] - STOPS[0]) * x) / (canvas.width - 1);
    ctx.fillStyle = `rgb(${falseColor(2 ** stops).join(' ')})`;
    ctx.fillRect(x, 0, 1, canvas.height);
  }
}

export const scaleLabels = () => {
  const labels = [];
  for (let stop = STOPS[0]; stop <= STOPS[1]; stop += 2) labels.push([stop < 0 ? `1/${2 ** -stop}` : String(2 ** stop), (stop - STOPS[0]) / (STOPS[1] - STOPS[0])]);
  return labels;
};
