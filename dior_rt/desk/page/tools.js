// Pen, mouse and touch on the stage: each tool makes a shape of the way that the pointer takes.

import { hueOf, decode, mixColor } from './color.js';
import { newShape } from './model.js';

const ROUND = 10; // tenths of a photo pixel are kept
const round = ([x, y]) => [Math.round(x * ROUND) / ROUND, Math.round(y * ROUND) / ROUND];

/** The width of the brush in photo pixels. */
export const brushWidth = (state, [width, height]) => Math.max(0.5, state.size * Math.max(width, height));

/** What every new shape gets from the brush. */
function paint(state) {
  return { color: mixColor(state.color), intensity: state.color.strength, flow: state.flow, softness: state.softness };
}

/** kind -> how the points of a drag become a shape; null while they are no shape yet. */
const MAKE = {
  brush: (state, drag, size) => stroke(state, drag, size, false),
  eraser: (state, drag, size) => stroke(state, drag, size, true),
  lasso: (state, drag) => (drag.points.length < 3 ? null : newShape({ ...paint(state), kind: 'fill', points: drag.points, softness: state.softness })),
  gradient: (state, drag) => (drag.far ? newShape({ ...paint(state), kind: 'gradient', points: [drag.points[0], drag.points.at(-1)] }) : null),
  glow: (state, drag) => {
    if (!drag.far) return null;
    const [[x, y], [ex, ey]] = [drag.points[0], drag.points.at(-1)];
    const radius = Math.hypot(ex - x, ey - y);
    return newShape({ ...paint(state), kind: 'glow', points: [[x, y], [x + radius, y], [x, y + radius]].map(round) });
  },
};

function stroke(state, drag, size, erase) {
  const straight = drag.straight && drag.points.length > 1;
  const points = straight ? [drag.points[0], drag.points.at(-1)] : drag.points;
  const pressure = drag.pen ? (straight ? [drag.pressure[0], drag.pressure.at(-1)] : drag.pressure) : [];
  return newShape({ ...paint(state), points, pressure, width: brushWidth(state, size), erase, thins: state.thins && drag.pen, fades: state.fades && drag.pen });
}

export class Tools {
  #drag = null;
  #touches = new Map();
  #pan = null;
  #penSeen = false;
  #lastEnd = null;
  spaceHeld = false;

  /** desk: {stage, view, ui, history, live(shape), draw(shape), pick(color), moved()}. */
  constructor(desk) {
    this.desk = desk;
    const { canvas } = desk.stage;
    canvas.addEventListener('pointerdown', (event) => this.#down(event));
    canvas.addEventListener('pointermove', (event) => this.#move(event));
    for (const name of ['pointerup', 'pointercancel']) canvas.addEventListener(name, (event) => this.#up(event));
    canvas.addEventListener('pointerleave', () => this.#hover(null));
    canvas.addEventListener('wheel', (event) => this.#wheel(event), { passive: false });
    canvas.addEventListener('contextmenu', (event) => event.preventDefault());
  }

  get tool() {
    return this.spaceHeld ? 'hand' : this.desk.ui.state.tool;
  }

  #down(event) {
    const { stage, history } = this.desk;
    if (!history.doc || event.button > 1) return;
    stage.canvas.setPointerCapture(event.pointerId);
    if (event.pointerType === 'pen') this.#penSeen = true;
    if (event.pointerType === 'touch') {
      this.#touches.set(event.pointerId, [event.offsetX, event.offsetY]);
      if (this.#touches.size === 2) return this.#cancelDrag();
    }
    // Once a pen has drawn, fingers move the photo: the palm on the glass draws nothing.
    const pans = this.tool === 'hand' || event.button === 1 || (event.pointerType === 'touch' && this.#penSeen);
    if (pans) {
      this.#pan = [event.offsetX, event.offsetY];
    } else if (this.tool === 'picker') {
      this.desk.pick(this.#pickColor(event));
    } else if (!this.#drag) {
      this.#begin(event);
    }
  }

  #begin(event) {
    const { ui } = this.desk;
    const start = round(this.desk.view.toPhoto(event.offsetX, event.offsetY));
    const joins = event.shiftKey && this.#lastEnd && ['brush', 'eraser'].includes(this.tool);
    this.#drag = {
      id: event.pointerId, tool: this.tool, state: ui.state, pen: event.pointerType === 'pen', straight: joins, far: false,
      points: joins ? [this.#lastEnd, start] : [start], pressure: joins ? [event.pressure, event.pressure] : [pressureOf(event)],
    };
    this.#show();
  }

  #move(event) {
    this.#hover(event);
    if (this.#touches.has(event.pointerId)) {
      if (this.#touches.size === 2) return this.#pinch(event);
      this.#touches.set(event.pointerId, [event.offsetX, event.offsetY]);
    }
    if (this.#pan) {
      this.desk.view.pan(event.offsetX - this.#pan[0], event.offsetY - this.#pan[1]);
      this.#pan = [event.offsetX, event.offsetY];
      return this.desk.moved();
    }
    const drag = this.#drag;
    if (!drag || drag.id !== event.pointerId) return;
    if (event.shiftKey) drag.straight = true;
    const all = event.getCoalescedEvents?.() ?? [];
    for (const one of all.length ? all : [event]) this.#append(drag, one, event);
    this.#show();
  }

  #append(drag, event, parent) {
    // Coalesced events have offsets of their own only in some browsers.
    const box = parent.target.getBoundingClientRect();
    const point = round(this.desk.view.toPhoto(event.clientX - box.left, event.clientY - box.top));
    const [x, y] = drag.points.at(-1);
    const moved = Math.hypot(point[0] - x, point[1] - y) * this.desk.view.scale;
    if (moved < 1.5) return;
    drag.far ||= Math.hypot(point[0] - drag.points[0][0], point[1] - drag.points[0][1]) * this.desk.view.scale > 4;
    drag.points = [...drag.points, point];
    drag.pressure = [...drag.pressure, pressureOf(event)];
  }

  #up(event) {
    this.#touches.delete(event.pointerId);
    this.#pan = null;
    const drag = this.#drag;
    if (!drag || drag.id !== event.pointerId) return;
    if (event.type === 'pointercancel') return this.#cancelDrag();
    this.#drag = null;
    const shape = this.#shape(drag);
    this.#lastEnd = drag.points.at(-1);
    this.desk.live(null, null);
    if (shape) this.desk.draw(shape);
  }

  #cancelDrag() {
    this.#drag = null;
    this.desk.live(null, null);
  }

  #shape(drag) {
    return MAKE[drag.tool](drag.state, drag, this.desk.history.doc.photo.size);
  }

  #show() {
    this.desk.live(this.#shape(this.#drag), this.#drag.tool);
  }

  #pinch(event) {
    const [id] = [...this.#touches.keys()].filter((other) => other !== event.pointerId);
    const [other, before] = [this.#touches.get(id), this.#touches.get(event.pointerId)];
    const now = [event.offsetX, event.offsetY];
    const length = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]) || 1;
    const middle = [(now[0] + other[0]) / 2, (now[1] + other[1]) / 2];
    this.desk.view.zoom(length(now, other) / length(before, other), ...middle);
    this.desk.view.pan((now[0] - before[0]) / 2, (now[1] - before[1]) / 2);
    this.#touches.set(event.pointerId, now);
    this.desk.moved();
  }

  #wheel(event) {
    if (!this.desk.history.doc) return;
    event.preventDefault();
    if (event.shiftKey) this.desk.view.pan(-event.deltaY - event.deltaX, 0);
    else this.desk.view.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0016)), event.offsetX, event.offsetY);
    this.desk.moved();
  }

  #hover(event) {
    const { stage, ui, history, view } = this.desk;
    const draws = event && history.doc && ['brush', 'eraser'].includes(this.tool) && event.pointerType !== 'touch';
    stage.cursor = draws ? { x: event.offsetX, y: event.offsetY, radius: (brushWidth(ui.state, history.doc.photo.size) / 2) * view.scale } : null;
    stage.refresh();
  }

  #pickColor(event) {
    const { photo } = this.desk.stage;
    const [width, height] = this.desk.history.doc.photo.size;
    const [x, y] = this.desk.view.toPhoto(event.offsetX, event.offsetY);
    const ctx = new OffscreenCanvas(1, 1).getContext('2d');
    ctx.drawImage(photo, (x / width) * photo.width - 1, (y / height) * photo.height - 1, 3, 3, 0, 0, 1, 1);
    const rgb = [...ctx.getImageData(0, 0, 1, 1).data.slice(0, 3)].map((code) => decode(code / 255));
    return { kelvin: 6500, ...hueOf(rgb) };
  }
}

const pressureOf = (event) => Math.round((event.pointerType === 'pen' ? event.pressure : 1) * 1000) / 1000;
