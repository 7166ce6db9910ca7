// Previews: coarse ones while the pen moves, a fine one when it lifts, the finest when nothing happens for a while.
// One is under way at a time; the newest wish waits and takes the place of older ones.

const COARSE = 448;
const FINE = 1024;
const IDLE = 500; // milliseconds of rest before the finest

export class Previewer {
  #backend;
  #show;
  #busy = false;
  #wish = null;
  #idle = 0;
  #newest = 0;

  /** show({blob, asked, fine}) or show({error}); busy(whether). asked: when, fine: whether the pen had lifted. */
  constructor(backend, show, busy) {
    this.#backend = backend;
    this.#show = show;
    this.busy = busy;
    this.finest = 2048;
  }

  /** Ask for a preview. moving: the pen is down, so that a coarse one must do. */
  ask(photo, project, moving = false) {
    clearTimeout(this.#idle);
    this.#wish = { photo, project, longest: moving ? COARSE : FINE, asked: performance.now() };
    // What the pen's lifting asks for does not wait for a coarse one: the server drops that.
    if (!this.#busy || !moving) this.#work();
  }

  /** Forget what was asked for: another photo comes. */
  drop() {
    clearTimeout(this.#idle);
    this.#wish = null;
    this.#newest += 1;
    this.#busy = false;
    this.busy(false);
  }

  #refineLater({ photo, project }) {
    this.#idle = setTimeout(() => {
      this.#wish = { photo, project, longest: this.finest, asked: performance.now() };
      this.#work();
    }, IDLE);
  }

  async #work() {
    const number = ++this.#newest;
    this.#busy = true;
    this.busy(true);
    while (this.#wish && number === this.#newest) {
      const wish = this.#wish;
      this.#wish = null;
      try {
        const blob = await this.#backend.preview(wish.photo, wish.project, wish.longest);
        if (!blob || number !== this.#newest) continue;
        const fine = wish.longest === FINE;
        await this.#show({ blob, asked: wish.asked, fine });
        if (fine && this.finest > FINE && number === this.#newest && !this.#wish) this.#refineLater(wish);
      } catch (error) {
        if (number === this.#newest) this.#show({ error });
      }
    }
    if (number === this.#newest) {
      this.#busy = false;
      this.busy(false);
    }
  }
}
