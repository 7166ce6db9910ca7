// The canvas: photo, result, overlays, the shape under the pen, the brush's ring.

import { drawShape, LightRasters } from './raster.js';

export class Stage {
  photo = null; // ImageBitmap of the photo as it is
  relit = null; // ImageBitmap of the newest preview or result, or null
  map = null; // canvas of a Lumi map in false colour, or null
  clipped = null; // canvas that marks clipped pixels, or null
  live = null; // the shape that is being drawn, or null
  ghost = null; // the shape that was drawn last, until its preview is there
  cursor = null; // {x, y, radius} on the screen, or null
  #frame = 0;
  #rasters = new LightRasters();

  /** onview is called when the view has changed. */
  constructor(canvas, view, history, ui, onview) {
    Object.assign(this, { canvas, view, history, ui, onview });
    new ResizeObserver(() => this.#resize()).observe(canvas.parentElement);
  }

  get box() {
    return this.canvas.parentElement.getBoundingClientRect();
  }

  /** Draw again, at the next frame. */
  refresh() {
    this.#frame ||= requestAnimationFrame(() => {
      this.#frame = 0;
      this.#draw();
    });
  }

  #resize() {
    const { width, height } = this.box;
    const ratio = window.devicePixelRatio || 1;
    const before = this.canvas.width / ratio;
    this.canvas.width = Math.max(1, Math.round(width * ratio));
    this.canvas.height = Math.max(1, Math.round(height * ratio));
    if (this.history.doc) {
      if (this.fitted || before < 2) this.fit();
      else this.refresh();
    }
  }

  fit() {
    this.fitted = true;
    this.view.fit(this.history.doc.photo.size, this.box, this.box.width < 600 ? 8 : 20);
    this.refresh();
    this.onview();
  }

  #draw() {
    const ctx = this.canvas.getContext('2d');
    const ratio = window.devicePixelRatio || 1;
    ctx.setTransform(1, 0, 0, 1, 0, 0);
    ctx.clearRect(0, 0, this.canvas.width, this.canvas.height);
    const { doc } = this.history;
    if (!doc || !this.photo) return;
    const [width, height] = doc.photo.size;
    const { view, overlay, split } = this.ui.state;
    const matrix = new DOMMatrix().scale(ratio).multiply(this.view.matrix);
    const picture = (bitmap) => {
      ctx.setTransform(matrix);
      ctx.imageSmoothingQuality = 'high';
      ctx.imageSmoothingEnabled = this.view.scale * (width / bitmap.width) < 4;
      ctx.drawImage(bitmap, 0, 0, width, height);
    };
    picture(view === 'photo' ? this.photo : this.relit ?? this.photo);
    if (view === 'split') {
      ctx.save();
      ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
      ctx.beginPath();
      ctx.rect(0, 0, split * this.box.width, this.box.height);
      ctx.clip();
      picture(this.photo);
      ctx.restore();
    }
    ctx.setTransform(matrix);
    if (overlay === 'drawn') this.#overlayLights(ctx, doc);
    else if (overlay === 'clip' && this.clipped && view !== 'photo') this.#stretch(ctx, this.clipped, width, height, false);
    else if (this.map && (overlay === 'source' || overlay === 'target')) this.#stretch(ctx, this.map, width, height, true);
    for (const shape of [this.ghost, this.live]) if (shape) this.#overlayShape(ctx, shape, [width, height]);
    this.#drawCursor(ctx, ratio);
  }

  #stretch(ctx, canvas, width, height, smooth) {
    ctx.imageSmoothingEnabled = smooth;
    ctx.drawImage(canvas, 0, 0, width, height);
  }

  #overlayLights(ctx, doc) {
    const [width, height] = doc.photo.size;
    const solo = doc.lights.some((light) => light.solo);
    ctx.fillStyle = 'rgb(0 0 0 / 0.55)';
    ctx.fillRect(0, 0, width, height);
    for (const light of doc.lights) {
      if (!light.on || (solo && !light.solo)) continue;
      ctx.globalAlpha = light.id === this.ui.state.selected ? 0.85 : 0.5;
      ctx.globalCompositeOperation = light.blend === 'multiply' ? 'multiply' : 'source-over';
      ctx.drawImage(this.#rasters.of(light, doc.photo.size), 0, 0, width, height);
    }
    ctx.globalCompositeOperation = 'source-over';
    ctx.globalAlpha = 1;
  }

  #overlayShape(ctx, shape, [width, height]) {
    ctx.save();
    ctx.beginPath();
    ctx.rect(0, 0, width, height);
    ctx.clip();
    if (shape.kind === 'fill') {
      ctx.globalAlpha = 0.4;
      drawShape(ctx, { ...shape, flow: 0.4, erase: false, softness: 0 });
    } else {
      drawShape(ctx, { ...shape, flow: 0.45 * shape.flow, erase: false, color: shape.erase ? [0, 0, 0] : shape.color });
    }
    ctx.restore();
  }

  #drawCursor(ctx, ratio) {
    if (!this.cursor) return;
    const { x, y, radius } = this.cursor;
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    for (const [width, color] of [[3, 'rgb(0 0 0 / 0.45)'], [1.2, 'rgb(255 255 255 / 0.9)']]) {
      ctx.beginPath();
      ctx.arc(x, y, Math.max(radius, 1.5), 0, 2 * Math.PI);
      ctx.lineWidth = width;
      ctx.strokeStyle = color;
      ctx.stroke();
    }
  }
}
