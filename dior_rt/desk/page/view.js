// Where the photo lies on the screen: zoom, pan and rotation, without limits but what floats allow.

export class View {
  scale = 1;
  angle = 0;
  x = 0;
  y = 0;

  /** Photo to screen, in CSS pixels. */
  get matrix() {
    return new DOMMatrix().translate(this.x, this.y).rotate(this.angle).scale(this.scale);
  }

  toPhoto(x, y) {
    const point = this.matrix.inverse().transformPoint({ x, y });
    return [point.x, point.y];
  }

  toScreen([x, y]) {
    const point = this.matrix.transformPoint({ x, y });
    return [point.x, point.y];
  }

  /** Show the whole photo in a box, with a margin. */
  fit([width, height], box, margin = 20) {
    const turned = Math.abs(this.angle % 180) === 90;
    const [across, down] = turned ? [height, width] : [width, height];
    this.scale = Math.max(1e-3, Math.min((box.width - 2 * margin) / across, (box.height - 2 * margin) / down));
    this.#centre([width, height], box);
  }

  /** Zoom so that what is at (x, y) on the screen stays there. */
  zoom(factor, x, y) {
    const next = Math.min(64, Math.max(0.005, this.scale * factor));
    const real = next / this.scale;
    this.x = x + (this.x - x) * real;
    this.y = y + (this.y - y) * real;
    this.scale = next;
  }

  pan(dx, dy) {
    this.x += dx;
    this.y += dy;
  }

  rotate(degrees, size, box) {
    this.angle = (this.angle + degrees) % 360;
    this.fit(size, box);
  }

  #centre([width, height], box) {
    [this.x, this.y] = [0, 0];
    const [x, y] = this.toScreen([width / 2, height / 2]);
    this.pan(box.width / 2 - x, box.height / 2 - y);
  }
}
