// The document: the lights on one photo, and how it changes. Values are never changed in place, so a state of the
// document is one object, and undo is a list of them.

import { t } from './strings.js';

export const newId = () => crypto.randomUUID();

/** A light with nothing drawn on it. */
export function newLight(fields = {}) {
  return { id: newId(), name: '', blend: 'add', on: true, solo: false, strength: 1, tint: [1, 1, 1], reach: 0.2, shapes: [], ...fields };
}

/** A shape with every key that a project has. */
export function newShape(fields) {
  return { kind: 'stroke', points: [], color: [1, 1, 1], intensity: 1, flow: 1, softness: 0.5, erase: false, width: 1, pressure: [], thins: false, fades: false, ...fields };
}

export function newDocument(photo) {
  return {
    photo: { size: photo.size, name: photo.name, sha256: photo.id },
    settings: { preset: null, steps: null, seed: 0, intensity: 1 },
    lights: [],
  };
}

/** What a project file holds of a document. */
export function toProject(doc) {
  return { format: 'dior project', version: 1, photo: doc.photo, settings: doc.settings, lights: doc.lights.map(({ id, ...light }) => light) };
}

export function fromProject(project) {
  return { photo: project.photo, settings: project.settings, lights: project.lights.map((light) => ({ id: newId(), ...light })) };
}

/** The document with one more shape on a light, or on a new one where there is none. */
export function withShape(doc, lightId, shape) {
  return withLight(doc, lightId, (light) => ({ ...light, shapes: [...light.shapes, shape] }));
}

export function withLight(doc, lightId, change) {
  return { ...doc, lights: doc.lights.map((light) => (light.id === lightId ? change(light) : light)) };
}

export function nextName(doc) {
  const taken = new Set(doc.lights.map((light) => light.name));
  let n = 1;
  while (taken.has(t.lights.newName(n))) n += 1;
  return t.lights.newName(n);
}

/** The document with its past and future. Emits "change" with {doc}; lists hold whole documents. */
export class History extends EventTarget {
  doc = null;
  #past = [];
  #future = [];
  #merging = null;

  /** Begin with another document: there is nothing to undo. */
  reset(doc) {
    this.doc = doc;
    [this.#past, this.#future, this.#merging] = [[], [], null];
    this.#tell();
  }

  /** Change the document. Changes that follow one another with the same `merge` key are undone as one. */
  commit(doc, merge = null) {
    if (doc === this.doc) return;
    if (!merge || merge !== this.#merging) this.#past.push(this.doc);
    this.#merging = merge;
    this.#future = [];
    this.doc = doc;
    this.#tell();
  }

  /** The next change starts a step of its own: a slider was let go. */
  settle() {
    this.#merging = null;
  }

  undo() {
    if (this.#past.length) this.#move(this.#past, this.#future);
  }

  redo() {
    if (this.#future.length) this.#move(this.#future, this.#past);
  }

  get canUndo() {
    return this.#past.length > 0;
  }

  get canRedo() {
    return this.#future.length > 0;
  }

  #move(from, to) {
    to.push(this.doc);
    this.doc = from.pop();
    this.#merging = null;
    this.#tell();
  }

  #tell() {
    this.dispatchEvent(new Event('change'));
  }
}

/** What the page remembers that is not the document: tool, brush, colours, selection, view. Emits "change". */
export class Ui extends EventTarget {
  state = {
    tool: 'brush', selected: null, view: 'relit', overlay: 'none', split: 0.5,
    size: 0.08, softness: 0.8, flow: 1, thins: true, fades: false,
    color: { kelvin: 3400, hue: 30, saturation: 0, strength: 2 },
    other: { kelvin: 9000, hue: 215, saturation: 0, strength: 1 },
  };

  set(patch) {
    this.state = { ...this.state, ...patch };
    this.dispatchEvent(new Event('change'));
  }
}
