// Shapes on a 2D canvas, for the eye. The server draws the light itself, from the same shapes.

import { toCss } from './color.js';

const RINGS = 8; // nested outlines that stand for a soft edge
const FILL_BLUR = 0.15; // sigma of a fill's soft edge, in its longer side
const LIGHTEST = 0.1; // share of width that a stroke keeps under the lightest pressure

/** Draw one shape, in photo pixels, over what the context holds. `tint` multiplies its colour. */
export function drawShape(ctx, shape, tint = [1, 1, 1]) {
  const color = toCss(shape.color.map((c, i) => c * tint[i] * Math.min(1, shape.intensity ** 0.4)));
  ctx.save();
  ctx.globalCompositeOperation = shape.erase ? 'destination-out' : 'source-over';
  ctx.fillStyle = color;
  DRAW[shape.kind](ctx, shape, color);
  ctx.restore();
}

const DRAW = { stroke: drawStroke, fill: drawFill, gradient: drawGradient, glow: drawGlow };

function drawStroke(ctx, shape) {
  // Rings from the outside in, each as opaque as lifts the coverage so far to its own.
  let covered = 0;
  const rings = shape.softness > 0.02 ? RINGS : 1;
  for (let ring = 1; ring <= rings; ring += 1) {
    const coverage = shape.flow * edge(ring / rings, shape.softness);
    const share = (coverage - covered) / (1 - covered || 1);
    covered = coverage;
    if (share <= 0) continue;
    ctx.globalAlpha = Math.min(1, share);
    ctx.fill(outline(shape, rings === 1 ? 1 : 1 - ((ring - 0.5) / rings) * shape.softness), 'nonzero');
  }
}

const edge = (x, softness) => (1 - softness) * x + softness * (x * x * (3 - 2 * x));

/** The area under a stroke whose radius is scaled, as one path. */
function outline(shape, scale) {
  const path = new Path2D();
  const { points, pressure, width } = shape;
  const radius = (i) => (scale * width * (shape.thins && pressure.length ? LIGHTEST + (1 - LIGHTEST) * pressure[i] : 1)) / 2;
  points.forEach(([x, y], i) => {
    path.moveTo(x + radius(i), y);
    path.arc(x, y, radius(i), 0, 2 * Math.PI);
    if (i === 0) return;
    const [x0, y0] = points[i - 1];
    const length = Math.hypot(x - x0, y - y0);
    if (length < 1e-6) return;
    const [nx, ny] = [-(y - y0) / length, (x - x0) / length];
    const [r0, r1] = [radius(i - 1), radius(i)];
    // The same sense of rotation as the circles', so that nothing cancels.
    path.moveTo(x0 - nx * r0, y0 - ny * r0);
    path.lineTo(x - nx * r1, y - ny * r1);
    path.lineTo(x + nx * r1, y + ny * r1);
    path.lineTo(x0 + nx * r0, y0 + ny * r0);
    path.closePath();
  });
  return path;
}

function drawFill(ctx, shape) {
  const extent = Math.max(...[0, 1].map((axis) => {
    const along = shape.points.map((point) => point[axis]);
    return Math.max(...along) - Math.min(...along);
  }));
  // A filter's lengths are pixels of the canvas. Browsers without filters show a hard edge.
  const { a, b } = ctx.getTransform();
  if (shape.softness > 0) ctx.filter = `blur(${FILL_BLUR * shape.softness * extent * Math.hypot(a, b)}px)`;
  ctx.globalAlpha = shape.flow;
  ctx.beginPath();
  shape.points.forEach(([x, y], i) => (i ? ctx.lineTo(x, y) : ctx.moveTo(x, y)));
  ctx.closePath();
  ctx.fill('evenodd');
}

function drawGradient(ctx, shape, color) {
  const [[x0, y0], [x1, y1]] = shape.points;
  fade(ctx, ctx.createLinearGradient(x0, y0, x1, y1), color, shape.flow, 0);
  ctx.fillRect(-1e5, -1e5, 2e5, 2e5);
}

function drawGlow(ctx, shape, color) {
  const [[cx, cy], [ax, ay], [bx, by]] = shape.points;
  ctx.transform(ax - cx, ay - cy, bx - cx, by - cy, cx, cy);
  fade(ctx, ctx.createRadialGradient(0, 0, 0, 0, 0, 1), color, shape.flow, 1 - Math.max(shape.softness, 0.02));
  ctx.beginPath();
  ctx.arc(0, 0, 1, 0, 2 * Math.PI);
  ctx.fill();
}

/** Colour stops from full to nothing; `start` is where the fall begins. */
function fade(ctx, gradient, color, flow, start) {
  const clear = color.replace('/ 1)', '/ 0)');
  gradient.addColorStop(0, color);
  for (let i = 0; i <= 6; i += 1) {
    const at = i / 6;
    const kept = 1 - at * at * (3 - 2 * at);
    gradient.addColorStop(start + (1 - start) * at, i === 6 ? clear : color.replace('/ 1)', `/ ${kept.toFixed(3)})`));
  }
  ctx.globalAlpha = flow;
  ctx.fillStyle = gradient;
}

/** Canvases of lights, kept by their shapes: the overlay of what is drawn. */
export class LightRasters {
  #kept = new Map();

  /** A canvas of at most `longest` pixels with one light's shapes. */
  of(light, [width, height], longest = 1024) {
    const key = light.shapes;
    const tint = light.tint.join();
    const known = this.#kept.get(light.id);
    if (known && known.key === key && known.tint === tint) return known.canvas;
    const scale = Math.min(1, longest / Math.max(width, height));
    const canvas = new OffscreenCanvas(Math.max(1, Math.round(width * scale)), Math.max(1, Math.round(height * scale)));
    const ctx = canvas.getContext('2d');
    ctx.scale(scale, scale);
    for (const shape of light.shapes) drawShape(ctx, shape, light.tint);
    this.#kept.set(light.id, { key, tint, canvas });
    return canvas;
  }
}
